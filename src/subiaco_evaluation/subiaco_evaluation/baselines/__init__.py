"""The simple methods that people use today, with the same outputs as the change run."""

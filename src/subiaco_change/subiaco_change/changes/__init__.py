"""Objects of two epochs: association, measures, decisions (method, parts D and E)."""

"""Places that were visited twice: found, registered and checked."""

"""The ``subiaco`` command: one verb a job, each calling one library function."""

"""Independent tasks with stored results and interchangeable executors."""

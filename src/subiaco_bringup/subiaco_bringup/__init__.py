"""The one place that composes: the command line, the node graph, launch files."""

"""The command line: parse, call a pipeline, say what came of it."""

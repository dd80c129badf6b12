"""The command line of sonotwin: `sonotwin VERB [field=value ...]`."""

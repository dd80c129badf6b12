"""One module a verb: its docstring is the verb's help, `Config` what it takes, `run(config)` does the work."""

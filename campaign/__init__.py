"""Attacks on every command: bad inputs, fuzzed files, kills, full disks, two writers, long runs."""

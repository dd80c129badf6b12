"""Looks of tracked bodies, a module each with a class `Kind` of `scenes.handheld.body_look.Look`."""

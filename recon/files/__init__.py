"""File formats of others, and files that appear whole or not at all."""

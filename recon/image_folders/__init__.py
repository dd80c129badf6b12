"""Folders of images that were recorded elsewhere: which camera took each, in which pose, under which pattern."""

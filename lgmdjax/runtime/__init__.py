"""Run folders, files, compilation caches, versions."""

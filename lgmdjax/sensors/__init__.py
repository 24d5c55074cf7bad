"""Stereo fisheye camera, laser scanner, and laboratory stimuli for both eyes."""

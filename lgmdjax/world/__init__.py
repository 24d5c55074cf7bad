"""Rooms as arrays: walls, upright prisms and cylinders, their textures, and rays cast into them."""

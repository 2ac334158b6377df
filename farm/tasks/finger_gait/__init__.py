"""Finger gaiting: an Allegro hand changes its grip of an object by touch (Plage 2016)."""

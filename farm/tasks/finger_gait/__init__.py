"""Finger gaiting: an Allegro hand changes its grip of an object (Plage 2016)."""

"""A task of one's own, tried before it is learnt."""

"""Which job of a round is where, over workers that come and go; pure."""

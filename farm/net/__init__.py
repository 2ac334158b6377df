"""How learner and workers speak: bytes, keys, certificates, messages."""

"""Communication between learner and workers: encoding, keys, certificates, messages."""

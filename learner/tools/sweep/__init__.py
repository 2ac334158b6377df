"""Many runs on one set of workers: sweeps, and races of settings."""

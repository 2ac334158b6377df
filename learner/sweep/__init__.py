"""Many runs on one set of workers."""

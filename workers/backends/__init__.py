"""The simulation backends of workers."""

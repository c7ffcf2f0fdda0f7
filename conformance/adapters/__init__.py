"""The adapters of our own implementations. Each is imported only when it is asked for, so that no backend is needed for
another."""

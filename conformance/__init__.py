"""The conformance kit: checks written once that judge any implementation through an adapter."""

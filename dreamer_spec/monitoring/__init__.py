"""What people see of a run: metrics, progress, the curve, predictions, films, and its outcome."""

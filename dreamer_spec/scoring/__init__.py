"""`train score`: final scores of runs by a stated protocol, normalized, with intervals, beside the paper's."""

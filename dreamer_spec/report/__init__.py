"""`train report`: one HTML page about one run or many."""

"""Speed against accuracy on three levels: what `experiments.accuracy_vs_speed` measures, draws and compares."""

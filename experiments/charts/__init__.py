"""Speed against accuracy on three levels: what `experiments.speed.accuracy_vs_speed` measures, draws and compares."""

"""Value of a correction of the simulator: policies trained on each simulator, judged on all of them."""

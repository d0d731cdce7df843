"""What a correction of the simulator is worth: policies trained on each simulator, judged on all of them."""

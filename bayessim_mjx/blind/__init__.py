"""The blind check: which missing effects a diagnosis would find on a robot and its logs, and which it would not."""

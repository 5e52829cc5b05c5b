"""What every room builds on: numerical ground rules, trees of tensors, whole files, PyTorch's insides."""

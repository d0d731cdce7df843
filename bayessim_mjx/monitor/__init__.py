"""What a person sees: TensorBoard files, plots, videos and the console. Takes results and computes nothing about them."""

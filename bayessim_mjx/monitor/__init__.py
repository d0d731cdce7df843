"""What a person sees: TensorBoard files, plots, videos and the console. Shows results, computes none."""

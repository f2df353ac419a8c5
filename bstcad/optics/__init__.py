"""Physics of light and lenses in differentiable torch, without scenes and files, in seven rooms."""

"""Plans and many designs: previews, predictions, choice of a net, neglected effects, batches and trade-offs."""

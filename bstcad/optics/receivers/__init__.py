"""Where light is collected: planes and directions, their pixels, and the goals on them."""

"""Rounds of cutting and measuring: the next part to cut, from the parts that were measured."""

"""The lenses of the solids' tests."""

from tests.cad.conftest import make_lens

__all__ = ["make_lens"]

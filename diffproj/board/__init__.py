"""The board, what cameras saw of it, and how its corners are found in photographs."""

from diffproj.board.chessboard import Axes, Chessboard
from diffproj.board.detection import BoardNotFoundError, BoardNotFoundWarning, detect
from diffproj.board.examples import Side, example_views
from diffproj.board.views import Views

__all__ = [
    "Axes",
    "BoardNotFoundError",
    "BoardNotFoundWarning",
    "Chessboard",
    "Side",
    "Views",
    "detect",
    "example_views",
]

"""Words for poses of the board: where a person is to hold it, and how to move it there from where it is.

Left, right, up and down are those of camera 1's image; near is near to camera 1. A tilt is named by the edge that comes nearer, a
turn in the image's plane by the clock.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from recon.board_guidance.board_room import Array, middles
from recon.model.boards import Board

ROUND_MM, ROUND_DEG = 10, 5  # that a person can tell


def placed(pose: Array, board: Board) -> str:
    """Words for a pose `world_from_board` : (4, 4) by itself."""
    x, y, z = middles(pose[None], board)[0]
    sides = [_amount(abs(x), "mm", "right" if x > 0 else "left"), _amount(abs(y), "mm", "down" if y > 0 else "up")]
    aside = " and ".join(filter(None, sides)) or "in the middle"
    turned = _turned(angles(pose)[2], "upside down" if not board.half_turn_is_alike else "")
    return ", ".join(filter(None, (f"hold it at {_rounded(z, ROUND_MM)} mm", aside, turned, *_tilts(*angles(pose)[:2]))))


def moves(asked: Array, held: Array, board: Board) -> str:
    """Words for the way from a held pose to the one asked for, `world_from_board` : (4, 4) both; "hold still" if it is there."""
    if there(asked, held, board):
        return "hold still"
    (x, y, z), (right, low, turn) = _shift(asked, held, board), _turns(asked, held, board)
    parts = [
        _amount(abs(z), "mm", "farther" if z > 0 else "nearer"),
        _amount(abs(x), "mm", "to the right" if x > 0 else "to the left"),
        _amount(abs(y), "mm", "down" if y > 0 else "up"),
        f"turn it {'clockwise' if turn > 0 else 'anticlockwise'} by {_rounded(abs(turn), ROUND_DEG)} deg"
        if _rounded(abs(turn), ROUND_DEG)
        else "",
        *_tilts(right, low),
    ]
    return ", ".join(filter(None, parts)) or "hold still"


def there(asked: Array, held: Array, board: Board) -> bool:
    """Whether a pose that is held is near enough to the one asked for."""
    turn = Rotation.from_rotvec(np.deg2rad([0, 0, 180]) * board.half_turn_is_alike).as_matrix()
    apart = min(Rotation.from_matrix(asked[:3, :3].T @ held[:3, :3] @ again).magnitude() for again in (np.eye(3), turn))
    there_mm, there_deg = 15.0, 8.0  # from the asked pose: near enough; nobody holds a board better
    return bool(np.linalg.norm(_shift(asked, held, board)) <= there_mm and np.rad2deg(apart) <= there_deg)


def angles(pose: Array) -> Array:
    """Tilts and turn : (3,) deg of a pose: its right edge nearer, its lower edge nearer, and clockwise, as camera 1 sees it."""
    normal, upright = pose[:3, 2], np.array([0.0, 0.0, 1.0])
    axis = np.cross(normal, upright)
    sine = np.linalg.norm(axis)
    back = Rotation.from_rotvec(axis / max(sine, 1e-12) * np.arctan2(sine, normal[2])).as_matrix() @ pose[:3, :3]
    turn = np.arctan2(back[1, 0], back[0, 0])
    return np.rad2deg([np.arctan2(normal[0], normal[2]), np.arctan2(normal[1], normal[2]), turn])


def _shift(asked: Array, held: Array, board: Board) -> Array:
    """From the held board's middle to the asked one's : (3,) mm."""
    return middles(asked[None], board)[0] - middles(held[None], board)[0]


def _turns(asked: Array, held: Array, board: Board) -> Array:
    """Change of the tilts and of the turn : (3,) deg, the turn the shorter way round."""
    change, circle = angles(asked) - angles(held), 180.0 if board.half_turn_is_alike else 360.0
    change[2] = (change[2] + circle / 2) % circle - circle / 2
    return change


def _tilts(right: float, low: float) -> list[str]:
    """Words for tilts, deg."""
    return [
        _amount(abs(right), "deg", "nearer", f"its {'right' if right > 0 else 'left'} edge "),
        _amount(abs(low), "deg", "nearer", f"its {'lower' if low > 0 else 'upper'} edge "),
    ]


def _turned(turn: float, half: str) -> str:
    """Words for a turn in the image's plane, deg, of a board whose long side lies down or stands."""
    quarter = round(turn / 90) % 4
    return ("", "turned clockwise by 90 deg", half, "turned anticlockwise by 90 deg")[quarter]


def _amount(value: float, unit: str, way: str, what: str = "") -> str:
    """An amount that a person can tell, or nothing."""
    amount = _rounded(value, ROUND_MM if unit == "mm" else ROUND_DEG)
    return f"{what}{amount} {unit} {way}" if amount else ""


def _rounded(value: float, step: int) -> int:
    """A value in whole steps."""
    return round(value / step) * step

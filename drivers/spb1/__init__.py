"""SPB1 blocks, the zero-copy form of frames on the wire and on disk: layout, writing, reading, walking a stream."""

from drivers.spb1.layout import ALIGN, HEADER_BYTES, TRAILER_BYTES, BlockLayout, block_views, frames_per_block
from drivers.spb1.reader import Damage, Placed, parse_block, walk_blocks, walk_placed
from drivers.spb1.writer import block_parts, seal_block

__all__ = [
    "ALIGN",
    "HEADER_BYTES",
    "TRAILER_BYTES",
    "BlockLayout",
    "Damage",
    "Placed",
    "block_parts",
    "block_views",
    "frames_per_block",
    "parse_block",
    "seal_block",
    "walk_blocks",
    "walk_placed",
]

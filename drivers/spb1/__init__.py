"""SPB1 blocks, the zero-copy form of frames on the wire and on disk: layout, writing, reading, walking a stream.

Input: frames to be written, or bytes from a device or a file. Output: sealed blocks; or sound blocks as views of these
bytes, and a `Damage` for each piece of them that holds no sound block. `control` and `receiver` serve live devices.
"""

from drivers.spb1.layout import ALIGN as ALIGN
from drivers.spb1.layout import HEADER_BYTES as HEADER_BYTES
from drivers.spb1.layout import TRAILER_BYTES as TRAILER_BYTES
from drivers.spb1.layout import BlockLayout as BlockLayout
from drivers.spb1.layout import block_parts as block_parts
from drivers.spb1.layout import block_views as block_views
from drivers.spb1.layout import frames_per_block as frames_per_block
from drivers.spb1.layout import seal_block as seal_block
from drivers.spb1.reader import Damage as Damage
from drivers.spb1.reader import Placed as Placed
from drivers.spb1.reader import parse_block as parse_block
from drivers.spb1.reader import walk_blocks as walk_blocks
from drivers.spb1.reader import walk_placed as walk_placed

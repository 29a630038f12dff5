"""List the stages in the order in which they run.

This is the only list of them; the entry point ``express50.stages`` leads here. It alone in this
package imports annotations.
"""

from annotations import align, observe
from pipelines import calibrate, depth, frames, ingest, matte, pack, regions, register, track

STAGES = (
    ingest.STAGE,
    calibrate.STAGE,
    observe.STAGE,
    align.STAGE,
    frames.STAGE,
    matte.STAGE,
    track.STAGE,
    depth.STAGE,
    register.STAGE,
    regions.STAGE,
    pack.ENCODE,
    pack.STAGE,
)

"""Remove a person from a checkpoint: codes, tracked frames, offsets and optimizer state."""

from __future__ import annotations

from pathlib import Path

from grmm.checkpoint import read_content, write_content


def redact(path: Path, subject: str) -> bool:
    """Remove a subject from a checkpoint in place; return True if it was there.

    A checkpoint of this person alone is deleted. Otherwise the rest renders the other people as
    before, but cannot be resumed: the optimizer's state had a row for the person. The decoders'
    weights, which all people share, stay as they are.

    Raises:
        FormatError: the file is not a checkpoint of 'grmm train' or 'fit'.
    """
    content = read_content(path)
    # The first checkpoints have neither offsets nor parameters, but hold people, too.
    named = {*content["subjects"], *content.get("offsets", {})}
    named |= {frame["subject"] for frame in content["frames"]}
    if subject not in named:
        return False
    if content["subjects"] == [subject]:
        path.unlink()
        return True
    rows = [row for row, name in enumerate(content["subjects"]) if name != subject]
    places = [n for n, frame in enumerate(content["frames"]) if frame["subject"] != subject]
    frames = [content["frames"][n] for n in places]
    # No other person shows an expression that this person alone performed.
    lost = {f["expression_id"] for f in content["frames"]} - {f["expression_id"] for f in frames}
    kept = [row for row, name in enumerate(content["expressions"]) if name not in lost]
    # Indexing with a list copies: a view would carry the removed row to the disk.
    codes = {"z_id": content["model"]["z_id"][rows], "z_exp": content["model"]["z_exp"][kept]}
    rest = {
        "subjects": [content["subjects"][row] for row in rows],
        "expressions": [content["expressions"][row] for row in kept],
        "model": content["model"] | codes,
        "frames": frames,
        "parameters": {k: v[places] for k, v in content.get("parameters", {}).items()},
        "offsets": {k: v for k, v in content.get("offsets", {}).items() if k != subject},
        "optimizer": {},
        "loop": {},
    }
    write_content(path, content | rest)
    return True

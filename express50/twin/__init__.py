"""Record synthetic raw captures, with ground truth beside them: the digital twin.

Heads are posed by a ``HeadModel`` and rendered by ray casting (Embree), never with the project's
own rasteriser. Only benchmarks, tests and reports open the truth, never a stage. Everything random
has its own generator, seeded by a list such as [seed, subject, 11, camera].
"""

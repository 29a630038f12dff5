"""The digital twin records synthetic raw captures, with ground truth kept beside them.

Heads are posed by a ``HeadModel`` and rendered by ray casting (Embree), never with the project's
own rasteriser. Truth is opened by benchmarks, tests and reports only, never by a stage.
Whatever is random has a generator of its own, seeded by a list such as [seed, subject, 11, camera].
"""

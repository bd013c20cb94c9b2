"""The four DMLab Rooms tasks in JAX: memory and navigation, thousands of rooms at a time.

Movement, pick-up volumes, rewards, doors, timers, layouts and randomness are DMLab's, number by number; `movement` and
a file a task hold them, `draw` the first-person view. What is drawn otherwise than in DMLab: patterns and outlines in
the place of its textures and models, objects that turn to the player, do not spin or bob and lie nearer to the floor
(those of the nonmatching task half as large again, and without the platforms they lie on), even light, and no head-up
display. JAX loads when one of these is first touched; `names` loads nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=[
        "collect",
        "deferred",
        "draw",
        "game",
        "layout",
        "movement",
        "names",
        "nonmatching",
        "players",
        "tasks",
        "watermaze",
    ],
    submod_attrs={"tasks": ["make"]},
)

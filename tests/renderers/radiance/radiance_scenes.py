"""Small scenes in Radiance's own grammar, whose light is known or quickly found."""

from __future__ import annotations

PLATE = """
void glow light
0
0
4 1 2 4 0

light source everywhere
0
0
4 0 0 1 360

void plastic grey
0
0
5 .5 .5 .5 0 0

grey polygon plate
0
0
12 -5 -5 0 5 -5 0 5 5 0 -5 5 0
"""
"""A plate that reflects half of the light that comes from everywhere, radiance 1, 2, 4: it has half of that."""

PLATE_CAMERA = """
up = [0, 1, 0]
fov = 40

[[keyframes]]
time = 0
origin = [0, 0, 6]
target = [0, 0, 0]

[[keyframes]]
time = 1
origin = [1, 0, 6]
target = [1, 0, 0]
"""

ROOM = """
void plastic wall
0
0
5 .6 .5 .4 0 0

void plastic block_paint
0
0
5 .3 .4 .6 0 0

void light lamp
0
0
3 20 20 20

!genbox wall room 4 3 2.5 -i
!genbox block_paint block .8 .8 1 | xform -t 2.4 1.6 0

lamp polygon panel
0
0
12 1.5 1 2.49 1.5 2 2.49 2.5 2 2.49 2.5 1 2.49
"""
"""A room with a block under a lamp."""

ROOM_CAMERA = """
fov = 70
fps = 4

[[keyframes]]
time = 0
origin = [0.4, 0.4, 1.5]
target = [3, 2, 0.8]

[[keyframes]]
time = 1
origin = [1.2, 0.4, 1.5]
target = [3, 2, 0.8]
"""

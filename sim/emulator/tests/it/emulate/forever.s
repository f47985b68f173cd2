// Runs on the spot.
.syntax unified
.thumb
    b .

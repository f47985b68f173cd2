#!/bin/sh
# Makes the files of this folder with tools that are not ours: GNU binutils for Arm, srec_cat (SRecord), Python's zlib.
# The results are committed; run this only to change them.
set -eu
cd "$(dirname "$0")"
arm-none-eabi-as -mcpu=cortex-m4 -mthumb -o program.o program.s
arm-none-eabi-ld -n -T program.ld -o program.elf program.o
arm-none-eabi-strip program.elf
arm-none-eabi-objcopy -O ihex program.elf program.hex
arm-none-eabi-objcopy -O srec --srec-forceS3 program.elf program.s3
srec_cat program.hex -Intel -offset -0x08000000 -Output program.s2 -Motorola -Address_Length=3 -Line_Length=44
srec_cat program.hex -Intel -Output program-srec_cat.hex -Intel -Line_Length=64
arm-none-eabi-objcopy -O binary --gap-fill 0xFF program.elf program.bin
rm program.o
python3 expected.py

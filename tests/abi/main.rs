//! The ABI between bootloader, application and tools, on the host: the layout of its structures, the
//! C header, and the way back into the bootloader in C. It needs no image and no emulator.

mod header;
mod layout;
mod numbers;
mod reentry;

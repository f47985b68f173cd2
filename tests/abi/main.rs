//! The ABI between bootloader, application and tools, on the host: the layout of its structures, the
//! C header, and the way back into the bootloader in C; and the names that an integrator knows from the
//! manuals. It needs no image and no emulator.

mod header;
mod layout;
mod manuals;
mod numbers;
mod reentry;

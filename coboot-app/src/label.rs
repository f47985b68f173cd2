//! The label: the data in a program image that identifies its device. With it the bootloader can
//! refuse an image for another device before it erases the installed program.

pub use shared_abi::label::{Label, OFFSET, SIZE};

/// The label of the program that runs, at its place after the vectors; `None` for a program without
/// one. The linker's block of the board names the place (`coboot_linker::Application`).
#[cfg(target_arch = "arm")]
#[must_use]
pub fn own() -> Option<Label> {
    extern "C" {
        static __label: [u8; SIZE];
    }
    // SAFETY: 32 bytes of the program's own flash, which nobody writes while it runs. Without a label
    // they are code, which `parse` tells from one.
    Label::parse(&unsafe { core::ptr::read_volatile(&raw const __label) })
}

/// Puts the label of the program at its place in the image, after the vector table: vendor-ID
/// (1018h/1), product code (1018h/2) and the version of the program, a number of the maker's own; and, if you
/// like, its date in seconds since 1970-01-01 UTC, which 1F52h shows. Once in a program, outside of functions.
///
/// ```
/// coboot_app::label!(vendor_id: 0x0000_0001, product_code: 0x0000_0002, version: 3);
/// # fn main() {}
/// ```
///
/// ```
/// coboot_app::label!(vendor_id: 1, product_code: 2, version: 3, date: 1_795_804_215);
/// # fn main() {}
/// ```
///
/// The linker script `application.x` places it. The linker fails if a program has two.
#[macro_export]
macro_rules! label {
    (vendor_id: $vendor_id:expr, product_code: $product_code:expr, version: $version:expr $(,)?) => {
        $crate::label!(vendor_id: $vendor_id, product_code: $product_code, version: $version, date: 0);
    };
    (vendor_id: $vendor_id:expr, product_code: $product_code:expr, version: $version:expr, date: $date:expr $(,)?) => {
        const _: () = {
            #[used]
            #[cfg_attr(target_arch = "arm", link_section = ".label")]
            static LABEL: $crate::label::Label =
                $crate::label::Label::dated($vendor_id, $product_code, $version, $date);
        };
    };
}

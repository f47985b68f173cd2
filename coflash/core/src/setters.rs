//! Setters for option structs.
//!
//! Such a struct is `#[non_exhaustive]`, so that a new option does not break its users. A user
//! starts from the default and sets the options that differ:
//! `FlashOptions::default().program(2).start(false)`.

/// Within an `impl` block: defines for each field a method with the field's name that sets it. For the
/// crates of coflash; it is no part of what this library promises.
#[doc(hidden)]
#[macro_export]
macro_rules! setters {
    ($($field:ident: $type:ty,)+) => {
        $(
            #[doc = concat!("The same with another [`", stringify!($field), "`](#structfield.", stringify!($field), ").")]
            #[must_use]
            pub fn $field(mut self, $field: $type) -> Self {
                self.$field = $field;
                self
            }
        )+
    };
}

//! Structs of options.
//!
//! Such a struct is `#[non_exhaustive]`, so that a new option does not break its users. A user
//! starts from the default and sets the options that differ:
//! `FlashOptions::default().program(2).start(false)`.

/// Defines a struct of options: each field with its default, and a method with its name that sets it. For
/// the crates of coflash; it is no part of what this library promises.
#[doc(hidden)]
#[macro_export]
macro_rules! options {
    (
        $(#[$meta:meta])*
        pub struct $options:ident {
            $($(#[$doc:meta])* pub $field:ident: $type:ty = $default:expr,)+
        }
    ) => {
        $(#[$meta])*
        #[non_exhaustive]
        pub struct $options {
            $($(#[$doc])* pub $field: $type,)+
        }

        impl $options {
            $(
                #[doc = concat!("The same with another [`", stringify!($field), "`](#structfield.", stringify!($field), ").")]
                #[must_use]
                pub fn $field(mut self, $field: $type) -> Self {
                    self.$field = $field;
                    self
                }
            )+
        }

        impl Default for $options {
            fn default() -> Self {
                Self { $($field: $default,)+ }
            }
        }
    };
}

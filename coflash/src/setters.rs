//! Setters for option structs.
//!
//! Such a struct is `#[non_exhaustive]`, so that an option more breaks nobody; its user starts from
//! the default and says what is different: `FlashOptions::default().program(2).start(false)`.

/// Within an `impl` block: for each field a method of its name that sets it.
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

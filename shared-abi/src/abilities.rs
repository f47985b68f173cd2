//! What a resident part has besides its services, and a RAM image may need.

/// A set of abilities, a bit each: those that an image needs, in its
/// [header](crate::ram_image::Header::features), and those that the resident part has, in its
/// [facts](crate::services::Facts::abilities), which have the lower half.
///
/// An ability that the reader does not know means "needs more than I have" in a header: the image is refused. In
/// the facts it means "has more than I need", and is ignored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(transparent)]
pub struct Abilities(pub u32);

impl Abilities {
    /// None.
    pub const NONE: Self = Self(0);
    /// The device takes sealed images. A resident part that knows them loads only an image that needs
    /// this: another one would take programs from anybody.
    pub const SEALED: Self = Self(1 << 0);
    /// The bootloader can be renewed: the resident part loads a RAM image from staging, too, and an image that
    /// takes part in a trial ends by itself, and installs itself ([`crate::renewal`]). An image without this
    /// runs from home alone.
    pub const RENEWAL: Self = Self(1 << 1);
    /// The device leaves for the loader in the ROM of the chip on request.
    pub const ROM_LOADER: Self = Self(1 << 2);
    /// The identity of the device is that of its [nameplate](crate::nameplate), if it has one.
    pub const NAMEPLATE: Self = Self(1 << 3);
    /// The resident part keeps the records of programs that the application has stored. No resident part has
    /// it yet.
    pub const INSTALL: Self = Self(1 << 4);

    /// With these abilities, too, `if` they are chosen.
    #[must_use]
    pub const fn with(self, others: Self, chosen: bool) -> Self {
        Self(self.0 | if chosen { others.0 } else { 0 })
    }

    /// Whether all of the others are among them.
    #[must_use]
    pub const fn has(self, others: Self) -> bool {
        others.0 & !self.0 == 0
    }
}

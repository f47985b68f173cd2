//! Sealed images: programs that a device accepts only from the holder of a key.
//!
//! The crate [`seal`] defines the file format `CBS1` and the device's side; this module has the
//! host's side.
//!
//! | module | what it is |
//! |---|---|
//! | [`key`] | keys and their files |
//! | [`certificate`] | what a root says of a release key |
//! | [`sealer`] | makes a sealed image of a program |
//! | [`open`] | takes a sealed image apart and checks it as a device does |
//! | [`blocks`] | one in a block file |
//! | [`show`] | what it says of itself, in words |
//! | [`key_block`](mod@key_block) | the keys in a device |
//! | [`provision`] | a bootloader with them |
//!
//! ```
//! use coflash_core::file::sealed::{key_block, verify, Certificate, Device, Role, Sealer, SigningKey};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let (root, release) = (SigningKey::from_seed([1; 32])?, SigningKey::from_seed([2; 32])?);
//! let certificate = Certificate {
//!     role: Role::Release,
//!     epoch: 1,
//!     vendor_id: 0x3F,
//!     product_code: 0,
//!     lowest: 0,
//!     highest: u32::MAX,
//!     key: release.public(),
//! };
//! let image = [0x5A; 5000];
//! let file = Sealer {
//!     certificate: Some(certificate.signed_by(&root)),
//!     vendor_id: 0x3F,
//!     product_code: 1234,
//!     counter: 7,
//!     compress: true,
//!     ..Sealer::default()
//! }
//! .seal(&image, &release)?;
//! let opened = verify(&file, &Device { roots: &[root.public()], ..Device::default() })?;
//! assert_eq!(opened.image.as_deref(), Some(&image[..]));
//! let in_the_device = key_block(&[root.public()], &[], 7, 1, false)?;
//! # assert_eq!(in_the_device.len(), 256);
//! # Ok(())
//! # }
//! ```

pub mod blocks;
pub mod certificate;
mod cipher;
pub mod key;
pub mod key_block;
mod lzma;
pub mod open;
pub mod provision;
pub mod sealer;
pub mod show;

pub use self::blocks::{carried, Carried};
pub use self::certificate::{Certificate, Role};
pub use self::cipher::hash;
pub use self::key::{Kek, KeyFault, PublicKey, SigningKey};
pub use self::key_block::{key_block, BlockFault};
pub use self::open::{verify, Device, Opened, Refusal, Sealed, SealedFile};
pub use self::sealer::{SealFault, Sealer, Unsigned};

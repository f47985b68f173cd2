//! The file `CBS1`: manifest, certificate, signatures, chunks. All numbers are little-endian.
//!
//! ```text
//! head    manifest (fixed fields, then records) · certificate (none or one) · signatures (1 to 3)
//! chunk   hash of the next chunk (32 bytes, 0 in the last one) · payload
//! ```
//!
//! The manifest contains the hash of the first chunk, and each chunk the hash of the next one. In
//! this chain one signature covers every byte, and 32 bytes of state are enough to check the bytes
//! as they arrive.

/// The first word of a sealed image: it is neither the number of a block nor an address in RAM, and
/// does not begin with `:`.
pub const MAGIC: [u8; 4] = *b"CBS1";
/// The first word of a certificate.
pub const CERTIFICATE_MAGIC: [u8; 4] = *b"CBK1";
/// The prefix of the manifest in the signed message, so that no other signed message can be taken
/// for a manifest.
pub const DOMAIN: &[u8; 22] = b"coboot sealed image 1\0";
/// The same for the manifest of a bootloader's RAM image: a signature over one is none over the other.
pub const BOOTLOADER_DOMAIN: &[u8; 27] = b"coboot sealed bootloader 1\0";
/// The program number of the bootloader's RAM image, on every device.
pub const BOOTLOADER: u8 = 255;
/// The prefix of the nonce when the key stream for a recipient is made from a key-encryption key.
pub const WRAP_DOMAIN: &[u8; 13] = b"coboot key 1\0";
/// The version of this format: a manifest that needs a higher one is refused.
pub const FORMAT: u16 = 1;

/// Bytes of the manifest's fixed fields.
pub const FIXED: usize = 176;
/// Bytes of the largest manifest.
pub const MAX_MANIFEST: usize = 1024;
/// Bytes of a certificate.
pub const CERTIFICATE: usize = 152;
/// Bytes of a certificate that the root's signature covers.
pub const CERTIFIED: usize = 88;
/// Bytes of a certificate that are 0, in front of the root's signature.
pub const RESERVED: usize = 24;
/// Bytes before a signature: key id, algorithm, length.
pub const SIGNATURE_HEADER: usize = 8;
/// Bytes of an Ed25519 signature (RFC 8032).
pub const SIGNATURE: usize = 64;
/// The largest head that a device accepts.
pub const MAX_HEAD: usize = 2048;
/// Bytes of a hash: SHA-512/256 (FIPS 180-4).
pub const HASH: usize = 32;
/// The smallest and the largest chunk: payload of this power of two.
pub const MIN_CHUNK: u8 = 9;
/// See [`MIN_CHUNK`].
pub const MAX_CHUNK: u8 = 13;

/// Algorithm of a signature: Ed25519 (RFC 8032). Others are skipped.
pub const ED25519: u16 = 1;

/// Flags of a manifest.
pub mod flag {
    /// The payload is encrypted.
    pub const ENCRYPTED: u8 = 1 << 0;
    /// The payload is compressed.
    pub const COMPRESSED: u8 = 1 << 1;
    /// The other program of the device is the dictionary of the compression.
    pub const DICTIONARY: u8 = 1 << 3;
    /// Data of the application, no program.
    pub const DATA: u8 = 1 << 4;
    /// The application writes to flash itself: the flash is not locked before it starts.
    pub const WRITES_FLASH: u8 = 1 << 5;
    /// Signed with a test key.
    pub const TEST: u8 = 1 << 6;
    /// All defined flags; an image with another one is refused.
    pub const KNOWN: u8 = ENCRYPTED | COMPRESSED | DICTIONARY | DATA | WRITES_FLASH | TEST;
}

/// Tags of the manifest's records: u16 tag, u16 length, bytes.
pub mod tag {
    /// An image with an unknown record with this bit is refused.
    pub const CRITICAL: u16 = 0x8000;
    /// A recipient of the encryption: key id, key check, wrapped key ([`super::Recipient`]).
    pub const RECIPIENT: u16 = 0x8001;
    /// Text for people.
    pub const TEXT: u16 = 0x0002;
    /// Hash of the software bill of materials.
    pub const SBOM: u16 = 0x0003;
    /// Revision of the source.
    pub const SOURCE: u16 = 0x0004;
    /// What the device of a bootloader's RAM image must have ([`super::Requirements`]).
    pub const BOOTLOADER: u16 = 0x8004;
}

/// Roles of a certified key.
pub mod role {
    /// Signs programs for the field.
    pub const RELEASE: u8 = 1;
    /// Signs programs for devices that are marked for tests.
    pub const TEST: u8 = 2;
    /// Signs bootloaders, and no programs. Its holder is as powerful as that of a root.
    pub const BOOTLOADER: u8 = 3;
}

/// Why a sealed image is refused. The numbers are those of the flash status (1F57h) of the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Fault {
    /// A field has an impossible value, or the size does not match the manifest.
    Format = 0x04,
    /// The image is larger than the flash of its program.
    Address = 0x0C,
    /// It is for another vendor's devices.
    WrongVendor = 0x80,
    /// It is for another product, program, device or hardware revision.
    WrongProduct = 0x82,
    /// Signature, certificate, chain or hash of the image is wrong.
    Signature = 0x8A,
    /// Security counter or epoch is lower than the device's.
    Rollback = 0x8C,
    /// The device has no key for it: neither the root key nor a key-encryption key.
    Key = 0x8E,
}

/// A word of a slice; the slice must be long enough.
#[inline(never)]
#[must_use]
pub fn word(bytes: &[u8], at: usize) -> u32 {
    bytes.iter().skip(at).take(4).rev().fold(0, |word, byte| word << 8 | u32::from(*byte))
}

/// A half word of a slice; the slice must be long enough.
#[must_use]
pub fn half(bytes: &[u8], at: usize) -> u16 {
    word(bytes, at) as u16
}

/// An array from a slice; zeros if the slice is too short.
#[must_use]
pub fn array<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
    bytes.get(at..at + N).and_then(|bytes| bytes.try_into().ok()).unwrap_or([0; N])
}

/// Reads a field of this type.
macro_rules! read {
    (u8, $bytes:expr, $at:literal) => {
        $bytes[$at]
    };
    (u16, $bytes:expr, $at:literal) => {
        half($bytes, $at)
    };
    (u32, $bytes:expr, $at:literal) => {
        word($bytes, $at)
    };
    (u64, $bytes:expr, $at:literal) => {
        u64::from_le_bytes(array($bytes, $at))
    };
    ($array:tt, $bytes:expr, $at:literal) => {
        array($bytes, $at)
    };
}

/// The fields of a record: the method that reads each, and its offset in bytes, with which a tool writes it.
macro_rules! fields {
    ($Record:ident, $offsets:ident:
        $($(#[$about:meta])* $name:ident $NAME:ident: $type:tt = $at:literal;)*
        $(; $($(#[$of:meta])* $hash:ident $HASH:ident = $from:literal;)*)?
    ) => {
        impl $Record<'_> {
            $(
                $(#[$about])*
                #[must_use]
                pub fn $name(self) -> $type {
                    read!($type, self.0, $at)
                }
            )*
        }

        $(impl<'a> $Record<'a> {
            $(
                $(#[$of])*
                #[must_use]
                pub fn $hash(self) -> &'a [u8] {
                    self.0.get($from..$from + HASH).unwrap_or(&[])
                }
            )*
        })?

        /// The offset of each field in bytes.
        pub mod $offsets {
            $(
                $(#[$about])*
                pub const $NAME: usize = $at;
            )*
            $($(
                $(#[$of])*
                pub const $HASH: usize = $from;
            )*)?
        }
    };
}

/// The size of an image's head, as far as these first bytes show it: the head is complete if the
/// result is not larger than the number of bytes.
///
/// # Errors
/// [`Fault::Format`] if the bytes cannot be a head.
pub fn head_size(bytes: &[u8]) -> Result<usize, Fault> {
    let have = bytes.len();
    if have < 8 {
        return Ok(8);
    }
    let manifest = usize::from(half(bytes, 4));
    let signatures = bytes[6];
    let possible = bytes.starts_with(&MAGIC)
        && (FIXED..=MAX_MANIFEST).contains(&manifest)
        && manifest.is_multiple_of(4)
        && (1..=3).contains(&signatures);
    if !possible {
        return Err(Fault::Format);
    }
    let mut at = manifest;
    if have < at + 4 {
        return Ok(at + 4);
    }
    if bytes[at..].starts_with(&CERTIFICATE_MAGIC) {
        at += CERTIFICATE;
    }
    for _ in 0..signatures {
        if have < at + SIGNATURE_HEADER {
            return Ok(at + SIGNATURE_HEADER);
        }
        at += SIGNATURE_HEADER + usize::from(half(bytes, at + 6));
        if at > MAX_HEAD {
            return Err(Fault::Format);
        }
    }
    Ok(at)
}

fields! { Head, head:
    /// Bytes of the manifest.
    manifest_size MANIFEST_SIZE: u16 = 4;
    /// Number of signatures.
    signatures SIGNATURES: u8 = 6;
    /// See the [flags](crate::wire::flag).
    flags FLAGS: u8 = 7;
    /// The vendor-ID of the devices for which the image is.
    vendor_id VENDOR_ID: u32 = 8;
    /// Their product code.
    product_code PRODUCT_CODE: u32 = 12;
    /// The version of the program.
    version VERSION: u32 = 16;
    /// The security counter: a device accepts none lower than its own.
    counter COUNTER: u32 = 20;
    /// The number of the program, 1 to 254: the sub-index of 1F50h; or that of the bootloader, 255.
    program PROGRAM: u8 = 24;
    /// Binary logarithm of a chunk's payload.
    chunk CHUNK: u8 = 25;
    /// The lowest version of this format that the bootloader must have.
    format FORMAT: u16 = 26;
    /// Bytes of the image as it is in flash.
    size SIZE: u32 = 28;
    /// CRC-32 of the image (1F56h).
    crc CRC: u32 = 32;
    /// Size of the payload after the signatures in bytes, without the hashes.
    payload PAYLOAD: u32 = 36;
    /// Hash of the first chunk.
    chain CHAIN: [u8; HASH] = 72;
    /// The nonce, which makes the encryption of each image different.
    nonce NONCE: [u8; 16] = 104;
    /// The 96-bit unique ID of the only device for which the image is, or zeros.
    unique_id UNIQUE_ID: [u8; 12] = 120;
    /// The hardware revisions for which the image is: bit n for revision numbers (1018h/3) with n
    /// in the five lowest bits; 0 for all revisions.
    hardware HARDWARE: u32 = 132;
    /// The time of creation, in seconds since 1970.
    created CREATED: u64 = 136;
;
    /// SHA-512/256 of the image.
    image_hash IMAGE_HASH = 40;
    /// Hash of the program that is the dictionary, or zeros.
    dictionary DICTIONARY = 144;
}

/// A complete head (as [`head_size`] reports).
#[derive(Clone, Copy, Debug)]
pub struct Head<'a>(pub &'a [u8]);

impl<'a> Head<'a> {
    /// The manifest: what the signatures cover.
    #[must_use]
    pub fn manifest(self) -> &'a [u8] {
        self.0.get(..usize::from(self.manifest_size())).unwrap_or(&[])
    }

    /// The prefix of the manifest in the signed message.
    #[must_use]
    pub fn domain(self) -> &'static [u8] {
        if self.program() == BOOTLOADER {
            BOOTLOADER_DOMAIN
        } else {
            DOMAIN
        }
    }

    /// The records of the manifest: tag and bytes. A record that exceeds the manifest is returned
    /// with the tag FFFFh.
    #[must_use]
    pub fn records(self) -> Records<'a> {
        Records(self.manifest().get(FIXED..).unwrap_or(&[]))
    }

    /// The certificate of the signing key, if there is one.
    #[must_use]
    pub fn certificate(self) -> Option<Certificate<'a>> {
        let behind = self.0.get(self.manifest().len()..)?;
        behind.starts_with(&CERTIFICATE_MAGIC).then(|| behind.get(..CERTIFICATE).map(Certificate))?
    }

    /// The Ed25519 signature of the key with this id.
    #[must_use]
    pub fn signature(self, key_id: u32) -> Option<&'a [u8; SIGNATURE]> {
        let certificate = if self.certificate().is_some() { CERTIFICATE } else { 0 };
        let mut at = self.manifest().len() + certificate;
        for _ in 0..self.signatures() {
            let length = half(self.0, at + 6);
            let fits = half(self.0, at + 4) == ED25519 && usize::from(length) == SIGNATURE;
            if fits && word(self.0, at) == key_id {
                return self.0.get(at + SIGNATURE_HEADER..)?.first_chunk();
            }
            at += SIGNATURE_HEADER + usize::from(length);
        }
        None
    }
}

/// The records of a manifest, see [`Head::records`].
#[derive(Clone, Debug)]
pub struct Records<'a>(&'a [u8]);

impl<'a> Iterator for Records<'a> {
    type Item = (u16, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        if self.0.is_empty() {
            return None;
        }
        let end = 4 + usize::from(half(self.0, 2));
        let tag = half(self.0, 0);
        let record = self.0.get(4..end);
        self.0 = self.0.get(end..).unwrap_or(&[]);
        Some(record.map_or((u16::MAX, &[]), |bytes| (tag, bytes)))
    }
}

/// What the device of a bootloader's RAM image must have, as in the header of the image: a record of
/// twelve bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Requirements {
    /// The identity of the board.
    pub board: u32,
    /// The lowest version of the services of the resident part.
    pub services: u32,
    /// The abilities of the resident part.
    pub features: u32,
}

impl Requirements {
    /// Bytes of the record.
    pub const SIZE: usize = 12;

    /// The requirements in a record; `None` if it has another size.
    #[must_use]
    pub fn parse(record: &[u8]) -> Option<Self> {
        (record.len() == Self::SIZE).then(|| Self {
            board: word(record, 0),
            services: word(record, 4),
            features: word(record, 8),
        })
    }

    /// The record.
    #[must_use]
    pub fn bytes(self) -> [u8; Self::SIZE] {
        let mut bytes = [0; Self::SIZE];
        for (word, at) in [self.board, self.services, self.features].into_iter().zip((0..).step_by(4)) {
            bytes[at..at + 4].copy_from_slice(&word.to_le_bytes());
        }
        bytes
    }
}

/// A recipient of the encryption: 44 bytes of a record.
#[derive(Clone, Copy, Debug)]
pub struct Recipient<'a>(pub &'a [u8; RECIPIENT]);

/// Bytes of a [`Recipient`].
pub const RECIPIENT: usize = 44;

fields! { Recipient, recipient:
    /// The id of the key-encryption key.
    key_id KEY_ID: u32 = 0;
    /// The check value that reveals a wrong key before anything is erased: bytes 32 to 39 of the
    /// key stream.
    check CHECK: [u8; 8] = 4;
    /// The key of the image, exclusive-or bytes 0 to 31 of the key stream: HMAC-SHA-512 (RFC 2104)
    /// with the key-encryption key over the [domain of key wrapping](crate::wire::WRAP_DOMAIN) and the nonce of the image.
    wrapped WRAPPED: [u8; 32] = 12;
}

/// A root's statement about a key that signs programs.
#[derive(Clone, Copy, Debug)]
pub struct Certificate<'a>(pub &'a [u8]);

fields! { Certificate, certificate:
    /// Its announced size: that of [a certificate](crate::wire::CERTIFICATE).
    size SIZE: u16 = 4;
    /// See the [roles](crate::wire::role).
    role ROLE: u8 = 6;
    /// Algorithm of the key: [Ed25519](crate::wire::ED25519).
    algorithm ALGORITHM: u8 = 7;
    /// A device accepts no certificate with an epoch lower than its own; a higher one becomes its
    /// own.
    epoch EPOCH: u32 = 8;
    /// For devices of this vendor.
    vendor_id VENDOR_ID: u32 = 12;
    /// For this product, or 0 for all of the vendor.
    product_code PRODUCT_CODE: u32 = 16;
    /// The lowest security counter that it may sign.
    lowest LOWEST: u32 = 20;
    /// The highest security counter that it may sign.
    highest HIGHEST: u32 = 24;
    /// The public key.
    key KEY: [u8; 32] = 28;
    /// The id of the signing root.
    root_id ROOT_ID: u32 = 60;
    /// The reserved bytes. They are 0, or the certificate is refused: a later format may restrict
    /// there what the key signs, and a device that does not know the restriction must not ignore it.
    reserved RESERVED: [u8; RESERVED] = 64;
    /// The root's signature.
    signature SIGNATURE: [u8; SIGNATURE] = 88;
}

impl<'a> Certificate<'a> {
    /// The bytes that the root's signature covers.
    #[must_use]
    pub fn signed(self) -> &'a [u8] {
        self.0.get(..CERTIFIED).unwrap_or(&[])
    }
}

const _: () = assert!(certificate::RESERVED + RESERVED == CERTIFIED && certificate::SIGNATURE == CERTIFIED);

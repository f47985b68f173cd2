//! The file `CBS1`: manifest, certificate, signatures, chunks. All numbers are little-endian.
//!
//! ```text
//! head    manifest (fixed fields, then records) · certificate (none or one) · signatures (1 to 3)
//! chunk   hash of the next chunk (32 bytes, 0 in the last one) · payload
//! ```
//!
//! The manifest holds the hash of the first chunk, each chunk that of the next one: a chain, so that
//! one signature covers every byte and 32 bytes of state are enough to check them as they come.

/// The first word of a sealed image: no number of a block, no `:`, no address in RAM.
pub const MAGIC: [u8; 4] = *b"CBS1";
/// The first word of a certificate.
pub const CERTIFICATE_MAGIC: [u8; 4] = *b"CBK1";
/// What stands in front of the manifest in the signed message, so that no other message that a key
/// signs is taken for a manifest.
pub const DOMAIN: &[u8; 22] = b"coboot sealed image 1\0";
/// What stands in front of the nonce when a key-encryption key makes the key stream for a recipient.
pub const WRAP_DOMAIN: &[u8; 13] = b"coboot key 1\0";
/// The version of this format: a manifest that wants a higher one is refused.
pub const FORMAT: u16 = 1;

/// Bytes of the manifest's fixed fields.
pub const FIXED: usize = 176;
/// Bytes of the largest manifest.
pub const MAX_MANIFEST: usize = 1024;
/// Bytes of a certificate.
pub const CERTIFICATE: usize = 152;
/// Bytes of a certificate that the root's signature covers.
pub const CERTIFIED: usize = 88;
/// Bytes in front of a signature: key id, algorithm, length.
pub const SIGNATURE_HEADER: usize = 8;
/// Bytes of an Ed25519 signature (RFC 8032).
pub const SIGNATURE: usize = 64;
/// The largest head that a device holds.
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
    /// The application writes the flash itself, so that the flash is not locked in front of it.
    pub const WRITES_FLASH: u8 = 1 << 5;
    /// Signed with a test key.
    pub const TEST: u8 = 1 << 6;
    /// All that have a meaning; an image with another one is refused.
    pub const KNOWN: u8 = ENCRYPTED | COMPRESSED | DICTIONARY | DATA | WRITES_FLASH | TEST;
}

/// Tags of the manifest's records: u16 tag, u16 length, bytes.
pub mod tag {
    /// An unknown record with this bit makes the image be refused.
    pub const CRITICAL: u16 = 0x8000;
    /// For whom the image is encrypted: key id, key check, wrapped key ([`super::Recipient`]).
    pub const RECIPIENT: u16 = 0x8001;
    /// Text for people.
    pub const TEXT: u16 = 0x0002;
    /// Hash of the software bill of materials.
    pub const SBOM: u16 = 0x0003;
    /// Revision of the source.
    pub const SOURCE: u16 = 0x0004;
}

/// Roles of a certified key.
pub mod role {
    /// Signs programs for the field.
    pub const RELEASE: u8 = 1;
    /// Signs programs for devices that are marked for tests.
    pub const TEST: u8 = 2;
}

/// Why a sealed image is refused. The numbers are those of the flash status (1F57h), which the
/// device shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Fault {
    /// A field has a value that it cannot have, or there is more or less than the manifest says.
    Format = 0x04,
    /// The image is larger than the flash of its program.
    Address = 0x0C,
    /// It is for another vendor's devices.
    WrongVendor = 0x80,
    /// It is for another product, program, device or hardware revision.
    WrongProduct = 0x82,
    /// Signature, certificate, chain or hash of the image.
    Signature = 0x8A,
    /// Security counter or epoch are lower than those of the device.
    Rollback = 0x8C,
    /// The device has no key for it: no such root key, or none that opens the encryption.
    Key = 0x8E,
}

/// A word of a slice that is long enough.
#[inline(never)]
#[must_use]
pub fn word(bytes: &[u8], at: usize) -> u32 {
    bytes.iter().skip(at).take(4).rev().fold(0, |word, byte| word << 8 | u32::from(*byte))
}

/// A half word of a slice that is long enough.
#[must_use]
pub fn half(bytes: &[u8], at: usize) -> u16 {
    word(bytes, at) as u16
}

/// An array of a slice, zeros where that is too short.
#[must_use]
pub fn array<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
    bytes.get(at..at + N).and_then(|bytes| bytes.try_into().ok()).unwrap_or([0; N])
}

/// How many bytes the head of an image has, as far as these first bytes tell: when it has no more
/// than there are, it is complete.
///
/// # Errors
/// [`Fault::Format`] as soon as the bytes cannot be a head.
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

/// A complete head ([`head_size`] says so).
#[derive(Clone, Copy, Debug)]
pub struct Head<'a>(pub &'a [u8]);

impl<'a> Head<'a> {
    /// The manifest: what the signatures cover.
    #[must_use]
    pub fn manifest(self) -> &'a [u8] {
        self.0.get(..usize::from(half(self.0, 4))).unwrap_or(&[])
    }

    /// Number of signatures.
    #[must_use]
    pub fn signatures(self) -> u8 {
        self.0[6]
    }

    /// See [`flag`].
    #[must_use]
    pub fn flags(self) -> u8 {
        self.0[7]
    }

    /// The vendor-ID of the devices that it is for.
    #[must_use]
    pub fn vendor_id(self) -> u32 {
        word(self.0, 8)
    }

    /// Their product code.
    #[must_use]
    pub fn product_code(self) -> u32 {
        word(self.0, 12)
    }

    /// The version of the program.
    #[must_use]
    pub fn version(self) -> u32 {
        word(self.0, 16)
    }

    /// The security counter: a device takes none that is lower than its own.
    #[must_use]
    pub fn counter(self) -> u32 {
        word(self.0, 20)
    }

    /// The number of the program, 1 to 254: the sub-index of 1F50h.
    #[must_use]
    pub fn program(self) -> u8 {
        self.0[24]
    }

    /// Binary logarithm of a chunk's payload.
    #[must_use]
    pub fn chunk(self) -> u8 {
        self.0[25]
    }

    /// The lowest version of this format that the bootloader must have.
    #[must_use]
    pub fn format(self) -> u16 {
        half(self.0, 26)
    }

    /// Bytes of the image as it is in flash.
    #[must_use]
    pub fn size(self) -> u32 {
        word(self.0, 28)
    }

    /// CRC-32 of the image (1F56h).
    #[must_use]
    pub fn crc(self) -> u32 {
        word(self.0, 32)
    }

    /// Bytes of payload behind the signatures, without the hashes.
    #[must_use]
    pub fn payload(self) -> u32 {
        word(self.0, 36)
    }

    /// SHA-512/256 of the image.
    #[must_use]
    pub fn image_hash(self) -> &'a [u8] {
        self.0.get(40..72).unwrap_or(&[])
    }

    /// Hash of the first chunk.
    #[must_use]
    pub fn chain(self) -> [u8; HASH] {
        array(self.0, 72)
    }

    /// What makes the encryption of this image differ from that of every other one.
    #[must_use]
    pub fn nonce(self) -> [u8; 16] {
        array(self.0, 104)
    }

    /// The 96-bit unique ID of the only device that it is for, or zeros.
    #[must_use]
    pub fn unique_id(self) -> [u8; 12] {
        array(self.0, 120)
    }

    /// Hardware revisions that it is for: bit n for those whose revision number (1018h/3) has n in
    /// its five lowest bits; 0 for all.
    #[must_use]
    pub fn hardware(self) -> u32 {
        word(self.0, 132)
    }

    /// When it was made, in seconds since 1970.
    #[must_use]
    pub fn created(self) -> u64 {
        u64::from_le_bytes(array(self.0, 136))
    }

    /// Hash of the program that is the dictionary, or zeros.
    #[must_use]
    pub fn dictionary(self) -> &'a [u8] {
        self.0.get(144..176).unwrap_or(&[])
    }

    /// The records of the manifest: tag and bytes. A record that reaches over the end of the
    /// manifest is told as tag FFFFh.
    #[must_use]
    pub fn records(self) -> Records<'a> {
        Records(self.manifest().get(FIXED..).unwrap_or(&[]))
    }

    /// The certificate of the key that signed, if there is one.
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

/// For whom an image is encrypted: 44 bytes of a record.
#[derive(Clone, Copy, Debug)]
pub struct Recipient<'a>(pub &'a [u8; RECIPIENT]);

/// Bytes of a [`Recipient`].
pub const RECIPIENT: usize = 44;

impl Recipient<'_> {
    /// The id of the key-encryption key.
    #[must_use]
    pub fn key_id(self) -> u32 {
        word(self.0, 0)
    }

    /// What tells a wrong key before anything is erased: bytes 32 to 39 of the key stream.
    #[must_use]
    pub fn check(self) -> [u8; 8] {
        array(self.0, 4)
    }

    /// The key of the image, exclusive-or bytes 0 to 31 of the key stream: HMAC-SHA-512 (RFC 2104)
    /// with the key-encryption key over [`WRAP_DOMAIN`] and the nonce of the image.
    #[must_use]
    pub fn wrapped(self) -> [u8; 32] {
        array(self.0, 12)
    }
}

/// What a root says of a key that signs programs.
#[derive(Clone, Copy, Debug)]
pub struct Certificate<'a>(pub &'a [u8]);

impl<'a> Certificate<'a> {
    /// What the root's signature covers.
    #[must_use]
    pub fn signed(self) -> &'a [u8] {
        self.0.get(..CERTIFIED).unwrap_or(&[])
    }

    /// Bytes that it says it has: [`CERTIFICATE`].
    #[must_use]
    pub fn len(self) -> u16 {
        half(self.0, 4)
    }

    /// Never.
    #[must_use]
    pub fn is_empty(self) -> bool {
        self.0.is_empty()
    }

    /// See [`role`].
    #[must_use]
    pub fn role(self) -> u8 {
        self.0[6]
    }

    /// Algorithm of the key: [`ED25519`].
    #[must_use]
    pub fn algorithm(self) -> u8 {
        self.0[7]
    }

    /// A device takes no certificate of a lower epoch than its own; a higher one becomes its own.
    #[must_use]
    pub fn epoch(self) -> u32 {
        word(self.0, 8)
    }

    /// For devices of this vendor.
    #[must_use]
    pub fn vendor_id(self) -> u32 {
        word(self.0, 12)
    }

    /// For this product, or 0 for all of the vendor.
    #[must_use]
    pub fn product_code(self) -> u32 {
        word(self.0, 16)
    }

    /// The lowest security counter that it may sign.
    #[must_use]
    pub fn lowest(self) -> u32 {
        word(self.0, 20)
    }

    /// The highest one.
    #[must_use]
    pub fn highest(self) -> u32 {
        word(self.0, 24)
    }

    /// The public key.
    #[must_use]
    pub fn key(self) -> [u8; 32] {
        array(self.0, 28)
    }

    /// The id of the root that signed.
    #[must_use]
    pub fn root_id(self) -> u32 {
        word(self.0, 60)
    }

    /// The root's signature.
    #[must_use]
    pub fn signature(self) -> [u8; SIGNATURE] {
        array(self.0, CERTIFIED)
    }
}

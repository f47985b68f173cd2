//! Keys and their files: Ed25519 keys in OpenSSL's formats (PKCS#8 and SPKI, PEM), and
//! key-encryption keys.
//!
//! No output contains a secret: `Debug` shows only the id of a key.

use std::fmt;

use ed25519_dalek::pkcs8::spki::der::pem::{self, LineEnding};
use ed25519_dalek::pkcs8::spki::{DecodePublicKey as _, EncodePublicKey as _};
use ed25519_dalek::pkcs8::{DecodePrivateKey as _, EncodePrivateKey as _, KeypairBytes};
use ed25519_dalek::{Signature, Signer as _, VerifyingKey};

use super::cipher::{hmac, id_of};

/// The label of a key-encryption key's PEM file.
const KEK_LABEL: &str = "COBOOT KEY ENCRYPTION KEY";
/// The text that precedes the manual's value when a key-encryption key is derived from it.
const VALUE_DOMAIN: &[u8] = b"coboot key of a value 1\0";

/// Why a key is invalid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum KeyFault {
    /// The text is not a PEM file of an Ed25519 private key.
    #[error("it is not an Ed25519 private key in PKCS#8 PEM: make one with `coflash seal keys new` or `openssl genpkey -algorithm ed25519`; decrypt a key with a password first (openssl pkey)")]
    NoPrivateKey,
    /// The text is not a PEM file of an Ed25519 public key.
    #[error("it is not an Ed25519 public key in PEM (SPKI): `coflash seal keys new` writes one beside the private key, or use `openssl pkey -pubout`")]
    NoPublicKey,
    /// The bytes are not a public key, or a key that accepts any signature.
    #[error("these 32 bytes are not an Ed25519 public key: the key is damaged; make a new one")]
    NoPoint,
    /// The text is not the file of a key-encryption key.
    #[error("it is not a key-encryption key: make one with `coflash seal keys new --role kek`, or give 64 hexadecimal digits")]
    NoKek,
    /// The id 0 means "no key".
    #[error("the id of this key is 0, which is reserved: make a new one")]
    ZeroId,
    /// The system provides no random numbers.
    #[error("the system provides no random numbers: make the key on another computer")]
    NoRandom,
}

/// 32 random bytes from the system.
fn random() -> Result<[u8; 32], KeyFault> {
    let mut bytes = [0; 32];
    getrandom::fill(&mut bytes).map_err(|_| KeyFault::NoRandom)?;
    Ok(bytes)
}

/// An Ed25519 private key (RFC 8032): signs programs, or, as a root, certifies other keys.
#[derive(Clone)]
pub struct SigningKey {
    key: ed25519_dalek::SigningKey,
    public: PublicKey,
}

impl SigningKey {
    /// Makes a new key.
    ///
    /// # Errors
    /// [`KeyFault::NoRandom`].
    pub fn generate() -> Result<Self, KeyFault> {
        Self::from_seed(random()?)
    }

    /// The key with these 32 bytes, which RFC 8032 calls the private key.
    ///
    /// # Errors
    /// [`KeyFault::ZeroId`].
    pub fn from_seed(seed: [u8; 32]) -> Result<Self, KeyFault> {
        let key = ed25519_dalek::SigningKey::from_bytes(&seed);
        let public = PublicKey::new(key.verifying_key().to_bytes())?;
        Ok(Self { key, public })
    }

    /// The key in a PKCS#8 PEM file without a password.
    ///
    /// # Errors
    /// [`KeyFault::NoPrivateKey`], [`KeyFault::ZeroId`].
    pub fn from_pem(text: &str) -> Result<Self, KeyFault> {
        let pair = KeypairBytes::from_pkcs8_pem(text.trim()).map_err(|_| KeyFault::NoPrivateKey)?;
        Self::from_seed(pair.secret_key)
    }

    /// The PKCS#8 PEM file as OpenSSL writes it (version 1: without the public key).
    #[must_use]
    pub fn to_pem(&self) -> String {
        let pair = KeypairBytes { secret_key: self.key.to_bytes(), public_key: None };
        // This fails only for a key that is too long, and this key has 32 bytes.
        pair.to_pkcs8_pem(LineEnding::LF).map_or_else(|_| String::new(), |text| text.to_string())
    }

    /// The public key.
    #[must_use]
    pub fn public(&self) -> PublicKey {
        self.public
    }

    /// Signs a message (pure Ed25519, RFC 8032 section 5.1.6).
    #[must_use]
    pub fn sign(&self, message: &[u8]) -> [u8; 64] {
        self.key.sign(message).to_bytes()
    }

    pub(super) fn seed(&self) -> [u8; 32] {
        self.key.to_bytes()
    }
}

impl fmt::Debug for SigningKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "SigningKey({:08X}h)", self.public.id())
    }
}

/// An Ed25519 public key.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct PublicKey([u8; 32]);

impl PublicKey {
    /// The key of these 32 bytes (RFC 8032 section 5.1.2).
    ///
    /// # Errors
    /// [`KeyFault::NoPoint`], [`KeyFault::ZeroId`].
    pub fn new(bytes: [u8; 32]) -> Result<Self, KeyFault> {
        let key = VerifyingKey::from_bytes(&bytes).map_err(|_| KeyFault::NoPoint)?;
        match () {
            () if key.is_weak() => Err(KeyFault::NoPoint),
            () if id_of(&bytes) == 0 => Err(KeyFault::ZeroId),
            () => Ok(Self(bytes)),
        }
    }

    /// The key in an SPKI PEM file.
    ///
    /// # Errors
    /// [`KeyFault::NoPublicKey`], and those of [`Self::new`].
    pub fn from_pem(text: &str) -> Result<Self, KeyFault> {
        let key = VerifyingKey::from_public_key_pem(text.trim()).map_err(|_| KeyFault::NoPublicKey)?;
        Self::new(key.to_bytes())
    }

    /// The SPKI PEM file as OpenSSL writes it.
    #[must_use]
    pub fn to_pem(&self) -> String {
        let key = VerifyingKey::from_bytes(&self.0);
        key.ok().and_then(|key| key.to_public_key_pem(LineEnding::LF).ok()).unwrap_or_default()
    }

    /// Its 32 bytes.
    #[must_use]
    pub fn bytes(&self) -> [u8; 32] {
        self.0
    }

    /// Its id: the first four bytes of its SHA-512, little-endian; never 0.
    #[must_use]
    pub fn id(&self) -> u32 {
        id_of(&self.0)
    }

    /// Whether this key has signed the message.
    #[must_use]
    pub fn verifies(&self, message: &[u8], signature: &[u8; 64]) -> bool {
        let signature = Signature::from_bytes(signature);
        VerifyingKey::from_bytes(&self.0).is_ok_and(|key| key.verify_strict(message, &signature).is_ok())
    }
}

impl fmt::Debug for PublicKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "PublicKey({:08X}h)", self.id())
    }
}

/// A key-encryption key: decrypts the keys of images for a product, or for one device.
#[derive(Clone, PartialEq, Eq)]
pub struct Kek([u8; 32]);

impl Kek {
    /// Makes a new key.
    ///
    /// # Errors
    /// [`KeyFault::NoRandom`], [`KeyFault::ZeroId`].
    pub fn generate() -> Result<Self, KeyFault> {
        Self::new(random()?)
    }

    /// The key of these bytes.
    ///
    /// # Errors
    /// [`KeyFault::ZeroId`].
    pub fn new(bytes: [u8; 32]) -> Result<Self, KeyFault> {
        if id_of(&bytes) == 0 {
            return Err(KeyFault::ZeroId);
        }
        Ok(Self(bytes))
    }

    /// The key derived from a value of 128 bits, which the manual's tools use for encryption: the
    /// first 32 bytes of HMAC-SHA-512 with the value as key over `coboot key of a value 1` and a
    /// zero.
    ///
    /// # Errors
    /// [`KeyFault::ZeroId`].
    pub fn of_value(value: [u8; 16]) -> Result<Self, KeyFault> {
        Self::new(seal::wire::array(&hmac(&value, &[VALUE_DOMAIN]), 0))
    }

    /// The key from its PEM file, or from a file with 64 hexadecimal digits (`openssl rand -hex
    /// 32`).
    ///
    /// # Errors
    /// [`KeyFault::NoKek`], [`KeyFault::ZeroId`].
    pub fn from_pem(text: &str) -> Result<Self, KeyFault> {
        let text = text.trim();
        let bytes = match pem::decode_vec(text.as_bytes()) {
            Ok((KEK_LABEL, bytes)) => Some(bytes),
            Ok(_) => None,
            Err(_) => hexadecimal(text),
        };
        let bytes = bytes.and_then(|bytes| bytes.try_into().ok());
        Self::new(bytes.ok_or(KeyFault::NoKek)?)
    }

    /// Its PEM file.
    #[must_use]
    pub fn to_pem(&self) -> String {
        pem::encode_string(KEK_LABEL, LineEnding::LF, &self.0).unwrap_or_default()
    }

    /// Its id: the first four bytes of its SHA-512, little-endian; never 0.
    #[must_use]
    pub fn id(&self) -> u32 {
        id_of(&self.0)
    }

    pub(super) fn secret(&self) -> &[u8; 32] {
        &self.0
    }
}

impl fmt::Debug for Kek {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Kek({:08X}h)", self.id())
    }
}

/// The bytes of hexadecimal digits.
pub fn hexadecimal(digits: &str) -> Option<Vec<u8>> {
    let value = |digit: u8| char::from(digit).to_digit(16).map(|value| value as u8);
    let pairs = digits.as_bytes().chunks(2);
    pairs.map(|pair| Some(value(*pair.first()?)? << 4 | value(*pair.get(1)?)?)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// RFC 8032 section 7.1, tests 1 and 2.
    const RFC_8032: [(&str, &str, &str, &str); 2] = [
        (
            "9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60",
            "d75a980182b10ab7d54bfed3c964073a0ee172f3daa62325af021a68f707511a",
            "",
            "e5564300c360ac729086e2cc806e828a84877f1eb8e5d974d873e065224901555fb8821590a33bacc61e39701cf9b46bd25bf5f0595bbe24655141438e7a100b",
        ),
        (
            "4ccd089b28ff96da9db6c346ec114e0f5b8a319f35aba624da8cf6ed4fb8a6fb",
            "3d4017c3e843895a92b70aa74d1b7ebc9c982ccf2ec4968cc0cd55f12af4660c",
            "72",
            "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da085ac1e43e15996e458f3613d0f11d8c387b2eaeb4302aeeb00d291612bb0c00",
        ),
    ];

    fn bytes<const N: usize>(digits: &str) -> [u8; N] {
        hexadecimal(digits).unwrap().try_into().unwrap()
    }

    #[test]
    fn signatures_are_those_of_rfc_8032() {
        for (seed, public, message, signature) in RFC_8032 {
            let key = SigningKey::from_seed(bytes(seed)).unwrap();
            let message = hexadecimal(message).unwrap();
            assert_eq!(key.public().bytes(), bytes(public));
            assert_eq!(key.sign(&message), bytes(signature));
            assert!(key.public().verifies(&message, &bytes(signature)));
            assert!(!key.public().verifies(b"another", &bytes(signature)));
        }
    }

    /// RFC 8410 section 10.3 and 10.1: the private key and the public key of its examples.
    #[test]
    fn pem_files_are_those_of_rfc_8410() {
        let private = "-----BEGIN PRIVATE KEY-----\n\
                       MC4CAQAwBQYDK2VwBCIEINTuctv5E1hK1bbY8fdp+K06/nwoy/HU++CXqI9EdVhC\n\
                       -----END PRIVATE KEY-----\n";
        let public = "-----BEGIN PUBLIC KEY-----\n\
                      MCowBQYDK2VwAyEAGb9ECWmEzf6FQbrBZ9w7lshQhqowtrbLDFw4rXAxZuE=\n\
                      -----END PUBLIC KEY-----\n";
        let key = SigningKey::from_pem(private).unwrap();
        assert_eq!(key.public(), PublicKey::from_pem(public).unwrap());
        assert_eq!((key.to_pem(), key.public().to_pem()), (private.to_string(), public.to_string()));
        assert_eq!(SigningKey::from_pem(&private.replace('\n', "\r\n")).unwrap().public(), key.public());
        assert_eq!(SigningKey::from_pem(public).unwrap_err(), KeyFault::NoPrivateKey);
        assert_eq!(PublicKey::from_pem(private).unwrap_err(), KeyFault::NoPublicKey);
        assert_eq!(
            SigningKey::from_pem(&private.replace("MC4C", "MC4D")).unwrap_err(),
            KeyFault::NoPrivateKey
        );
        for text in ["", "-----BEGIN PRIVATE KEY-----", "\u{1F511}"] {
            assert!(SigningKey::from_pem(text).is_err() && PublicKey::from_pem(text).is_err());
            assert_eq!(Kek::from_pem(text), Err(KeyFault::NoKek));
        }
    }

    /// SHA-512 over 32 zeros begins with 5046ADC1h (`head -c 32 /dev/zero | sha512sum`).
    #[test]
    fn an_id_is_the_beginning_of_the_hash() {
        assert_eq!(Kek::new([0; 32]).unwrap().id(), 0xC1AD_4650);
    }

    #[test]
    fn keys_of_small_order_are_none() {
        // The neutral element, and a point of order 2 (RFC 8032: y = 1 and y = -1).
        let mut one = [0; 32];
        one[0] = 1;
        assert_eq!(PublicKey::new(one), Err(KeyFault::NoPoint));
        let mut minus_one = [0xFF; 32];
        (minus_one[0], minus_one[31]) = (0xEC, 0x7F);
        assert_eq!(PublicKey::new(minus_one), Err(KeyFault::NoPoint));
    }

    #[test]
    fn a_key_encryption_key_comes_back_from_its_file_and_from_digits() {
        let kek = Kek::new([0xA5; 32]).unwrap();
        assert_eq!(Kek::from_pem(&kek.to_pem()), Ok(kek.clone()));
        assert_eq!(Kek::from_pem(&format!("{}\n", "a5".repeat(32))), Ok(kek.clone()));
        assert_eq!(Kek::from_pem(&"a5".repeat(31)), Err(KeyFault::NoKek));
        assert_eq!(Kek::from_pem(&"a5".repeat(33)), Err(KeyFault::NoKek));
        assert_eq!(Kek::from_pem(&SigningKey::from_seed([1; 32]).unwrap().to_pem()), Err(KeyFault::NoKek));
        assert!(!format!("{kek:?}").contains("a5a5") && !format!("{kek:?}").contains("165"));
        assert_ne!(Kek::generate().unwrap(), Kek::generate().unwrap());
    }
}

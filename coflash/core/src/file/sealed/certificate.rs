//! Certificates: a root's statement about a key that signs programs.

use seal::wire::{certificate as at, role, CERTIFICATE, CERTIFICATE_MAGIC, CERTIFIED, ED25519};

use super::key::{PublicKey, SigningKey};

/// What a certified key may sign.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum Role {
    /// Programs for the field.
    #[default]
    Release = role::RELEASE,
    /// Programs for devices that are marked for tests.
    Test = role::TEST,
    /// Bootloaders, and no programs. The holder of such a key is as powerful as that of a root.
    Bootloader = role::BOOTLOADER,
}

/// A root's statement about a key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Certificate {
    /// What the key may sign.
    pub role: Role,
    /// A device accepts no certificate with an epoch lower than the highest that it has seen: a
    /// higher epoch revokes the earlier keys.
    pub epoch: u32,
    /// For devices of this vendor (1018h/1).
    pub vendor_id: u32,
    /// For this product (1018h/2), or 0 for all of the vendor.
    pub product_code: u32,
    /// The lowest security counter that the key may sign.
    pub lowest: u32,
    /// The highest security counter that the key may sign.
    pub highest: u32,
    /// The key.
    pub key: PublicKey,
}

impl Certificate {
    /// The bytes that this root must sign, for a root in a hardware security module.
    #[must_use]
    pub fn tbs(&self, root: PublicKey) -> [u8; CERTIFIED] {
        let mut bytes = [0; CERTIFIED];
        let mut put = |at: usize, field: &[u8]| bytes[at..at + field.len()].copy_from_slice(field);
        put(0, &CERTIFICATE_MAGIC);
        put(at::SIZE, &(CERTIFICATE as u16).to_le_bytes());
        put(at::ROLE, &[self.role as u8]);
        put(at::ALGORITHM, &[ED25519 as u8]);
        put(at::EPOCH, &self.epoch.to_le_bytes());
        put(at::VENDOR_ID, &self.vendor_id.to_le_bytes());
        put(at::PRODUCT_CODE, &self.product_code.to_le_bytes());
        put(at::LOWEST, &self.lowest.to_le_bytes());
        put(at::HIGHEST, &self.highest.to_le_bytes());
        put(at::KEY, &self.key.bytes());
        put(at::ROOT_ID, &root.id().to_le_bytes());
        bytes
    }

    /// The certificate, signed by this root.
    #[must_use]
    pub fn signed_by(&self, root: &SigningKey) -> [u8; CERTIFICATE] {
        let tbs = self.tbs(root.public());
        let mut bytes = [0; CERTIFICATE];
        bytes[..CERTIFIED].copy_from_slice(&tbs);
        bytes[CERTIFIED..].copy_from_slice(&root.sign(&tbs));
        bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Field by field as in the table of the format.
    #[test]
    fn a_certificate_has_its_fields_where_the_format_says() {
        let (root, key) = (SigningKey::from_seed([1; 32]).unwrap(), SigningKey::from_seed([2; 32]).unwrap());
        let certificate = Certificate {
            role: Role::Test,
            epoch: 0x0102_0304,
            vendor_id: 0x1112_1314,
            product_code: 0x2122_2324,
            lowest: 0x3132_3334,
            highest: 0x4142_4344,
            key: key.public(),
        };
        let bytes = certificate.signed_by(&root);
        let front = b"CBK1\x98\0\x02\x01\x04\x03\x02\x01\x14\x13\x12\x11\x24\x23\x22\x21\x34\x33\x32\x31\x44\x43\x42\x41";
        assert_eq!(bytes[..28], front[..]);
        assert_eq!(bytes[28..60], key.public().bytes());
        assert_eq!(bytes[60..64], root.public().id().to_le_bytes());
        assert_eq!(bytes[64..88], [0; 24]);
        assert!(root.public().verifies(&bytes[..88], bytes[88..].try_into().unwrap()));
    }
}

//! Signed packages.

use coflash_core::file::sealed::{Certificate, PublicKey, Role, SigningKey};
use coflash_core::machine::zip::{self, Member};
use coflash_core::machine::{make, Entry, Fault, Identity, Package, Part, SignatureFault};

use super::{entry, refused, BLOCKS};

fn key(seed: u8) -> SigningKey {
    SigningKey::from_seed([seed; 32]).unwrap()
}

fn certificate(root: &SigningKey, key: &SigningKey, role: Role, product: u32) -> [u8; 152] {
    let certificate = Certificate {
        role,
        epoch: 1,
        vendor_id: 63,
        product_code: product,
        lowest: 0,
        highest: u32::MAX,
        key: key.public(),
    };
    certificate.signed_by(root)
}

fn part(identity: Option<Identity>) -> Part {
    let at_node: Entry = serde_json::from_str(&entry("drive", r#""nodes": [5]"#)).unwrap();
    let nodes = if identity.is_some() { vec![] } else { vec![5] };
    Part { entry: Entry { nodes, identity, ..at_node }, bytes: BLOCKS.to_vec() }
}

const DRIVE: Identity = Identity { vendor: 63, product: 1234, revision: None };

fn made(parts: &[Part], keys: &[(&SigningKey, Option<[u8; 152]>)]) -> Result<Vec<u8>, Fault> {
    make(Some("Press 4".to_owned()), None, parts, keys)
}

fn trust(bytes: &[u8], roots: &[PublicKey]) -> Result<(), Fault> {
    Package::parse(bytes)?.trust(roots).map(drop)
}

#[test]
fn a_root_or_a_key_that_it_has_certified_signs() {
    let (root, release, stranger) = (key(1), key(2), key(3));
    let ours = certificate(&root, &release, Role::Release, 0);
    let theirs = certificate(&stranger, &release, Role::Release, 0);
    let parts = [part(Some(DRIVE))];
    let by_root = made(&parts, &[(&root, None)]).unwrap();
    let by_release = made(&parts, &[(&release, Some(ours))]).unwrap();
    let by_stranger = made(&parts, &[(&release, Some(theirs))]).unwrap();
    let open = made(&parts, &[]).unwrap();
    let roots = [root.public()];
    for good in [&by_root, &by_release] {
        assert_eq!(trust(good, &roots), Ok(()));
        assert_eq!(trust(good, &[stranger.public(), root.public()]), Ok(()));
    }
    let stranger_at = |bytes: &[u8], key: u32, by: Option<u32>| {
        let fault = trust(bytes, &roots).unwrap_err();
        assert_eq!(fault, Fault::Signature(SignatureFault::Stranger { key, root: by }));
        assert_eq!(fault.number(), 0x6000_0408);
    };
    stranger_at(&by_stranger, release.public().id(), Some(stranger.public().id()));
    stranger_at(&made(&parts, &[(&stranger, None)]).unwrap(), stranger.public().id(), None);
    assert_eq!(trust(&open, &roots), Err(Fault::Signature(SignatureFault::None)));
    // Nobody has to trust a package: without roots it is read.
    assert!([by_root, by_stranger, open].iter().all(|bytes| Package::parse(bytes).is_ok()));
}

/// Role, vendor and product of the certificate, and nodes without an identity.
#[test]
fn a_key_signs_what_its_certificate_allows() {
    let (root, release) = (key(1), key(2));
    let sign = |role, product, part: Part| {
        made(&[part], &[(&release, Some(certificate(&root, &release, role, product)))])
    };
    for product in [0, 1234] {
        assert!(sign(Role::Release, product, part(Some(DRIVE))).is_ok());
    }
    let not_allowed = |result: Result<Vec<u8>, Fault>| {
        let fault = result.unwrap_err();
        assert!(matches!(fault, Fault::Signature(SignatureFault::NotAllowed { .. })), "{fault}");
        assert_eq!(fault.number(), 0x6000_0408);
    };
    not_allowed(sign(Role::Release, 1235, part(Some(DRIVE))));
    not_allowed(sign(Role::Release, 0, part(Some(Identity { vendor: 64, ..DRIVE }))));
    not_allowed(sign(Role::Release, 0, part(None)));
    not_allowed(sign(Role::Bootloader, 0, part(Some(DRIVE))));
    not_allowed(sign(Role::Test, 0, part(Some(DRIVE))));
    // A root may sign all of it, also beside a key that may not.
    assert!(made(&[part(None)], &[(&root, None)]).is_ok());
    let both = [(&root, None), (&release, Some(certificate(&root, &release, Role::Test, 0)))];
    assert!(made(&[part(None)], &both).is_ok());
}

/// A signer that no root knows does not make the signature of another one cover more.
#[test]
fn what_a_stranger_signs_counts_for_nothing() {
    let (root, release, stranger) = (key(1), key(2), key(3));
    let panel = Part { entry: Entry { name: "panel".to_owned(), ..part(None).entry }, ..part(None) };
    let keys = [(&release, Some(certificate(&root, &release, Role::Release, 0))), (&stranger, None)];
    let bytes = made(&[part(Some(DRIVE)), panel], &keys).unwrap();
    let fault = trust(&bytes, &[root.public()]).unwrap_err();
    let Fault::Signature(SignatureFault::NotAllowed { program, .. }) = fault else { panic!("{fault}") };
    assert_eq!(program, "panel");
}

/// The root is a stranger to whoever names another one: its signature is not among those that were checked.
#[test]
fn the_signers_of_the_named_roots_are_told_from_the_others() {
    let (root, release, other) = (key(1), key(2), key(3));
    let keys = [(&other, None), (&release, Some(certificate(&root, &release, Role::Release, 0)))];
    let package = Package::parse(&made(&[part(Some(DRIVE))], &keys).unwrap()).unwrap();
    let known = |roots: &[PublicKey]| {
        let known = package.trust(roots).unwrap();
        known.iter().map(|signer| signer.key).collect::<Vec<_>>()
    };
    let (release, other_id) = (release.public().id(), other.public().id());
    assert_eq!(known(&[root.public()]), [release]);
    assert_eq!(known(&[other.public()]), [other_id]);
    assert_eq!(known(&[root.public(), other.public()]), [other_id, release]);
}

/// Each byte of the file is changed: whoever trusts the root gets the same programs for the same devices,
/// or nothing.
#[test]
fn no_changed_byte_changes_what_is_signed() {
    let (root, release) = (key(1), key(2));
    let parts = [part(Some(DRIVE))];
    for keys in [(&root, None), (&release, Some(certificate(&root, &release, Role::Release, 0)))] {
        let good = made(&parts, &[keys]).unwrap();
        let said = Package::parse(&good).unwrap();
        let mut accepted = 0;
        for at in 0..good.len() {
            let mut file = good.clone();
            file[at] ^= 0x55;
            let Ok(package) = Package::parse(&file) else { continue };
            if package.trust(&[root.public()]).is_ok() {
                assert_eq!(package.manifest(), said.manifest(), "{at}");
                accepted += 1;
            }
        }
        // Versions and attributes of the three members, which nobody reads: 2 bytes in each header in front of
        // a member, and 4 + 6 in each entry of the directory.
        assert_eq!(accepted, 3 * (2 + 4 + 6));
    }
}

#[test]
fn signatures_that_are_none_are_refused() {
    let (root, release) = (key(1), key(2));
    let certified = certificate(&root, &release, Role::Release, 0);
    let good = made(&[part(Some(DRIVE))], &[(&release, Some(certified))]).unwrap();
    let with = |change: &dyn Fn(&mut Vec<u8>)| {
        let members = zip::read(&good).unwrap();
        let mut signatures = members[1].bytes.to_vec();
        change(&mut signatures);
        zip::write(&[members[0], Member { bytes: &signatures, ..members[1] }, members[2]])
    };
    assert_eq!(with(&|_| {}), good);
    // 4 bytes, the certificate of 152, the header of 8, the signature of 64.
    assert_eq!(zip::read(&good).unwrap()[1].bytes.len(), 4 + 152 + 8 + 64);
    let number = 0x6000_0408;
    refused(&with(&|bytes| bytes.clear()), number, "there are none");
    refused(&with(&|bytes| bytes.truncate(200)), number, "cut off");
    refused(&with(&|bytes| bytes.extend_from_within(..)), number, "a key has signed twice");
    refused(&with(&|bytes| bytes[0] = 151), number, "size of a certificate");
    refused(&with(&|bytes| bytes[2] = 1), number, "size of a certificate");
    refused(&with(&|bytes| bytes[4] = b'X'), number, "certificate is invalid");
    // A reserved byte of the certificate, at 64: a later restriction must not be ignored.
    refused(&with(&|bytes| bytes[4 + 64] = 1), number, "certificate is invalid");
    refused(&with(&|bytes| bytes[156] ^= 1), number, "that of another key");
    refused(&with(&|bytes| bytes[160] = 2), number, "not Ed25519");
    refused(&with(&|bytes| bytes[164] ^= 1), number, "changed after it was signed");
    // The root's signature: whoever names the root sees it.
    let fault = trust(&with(&|bytes| bytes[4 + 88] ^= 1), &[root.public()]).unwrap_err();
    assert!(matches!(fault, Fault::Signature(SignatureFault::Stranger { .. })), "{fault}");
    // Another manifest under the same signature.
    let members = zip::read(&good).unwrap();
    let other = String::from_utf8(members[0].bytes.to_vec()).unwrap().replace("Press 4", "Press 5");
    let file = zip::write(&[Member { bytes: other.as_bytes(), ..members[0] }, members[1], members[2]]);
    refused(&file, number, "changed after it was signed");
}

#[test]
fn the_same_input_gives_the_same_package() {
    let (root, parts) = (key(1), [part(Some(DRIVE))]);
    let keys = [(&root, None)];
    assert_eq!(made(&parts, &keys), made(&parts, &keys));
}

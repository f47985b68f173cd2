//! The head of a sealed image (`CBS1`), byte by byte at literal offsets, so that the tests do not share
//! the constants of the code.

/// Puts a number, the lowest byte first.
pub fn put(bytes: &mut [u8], at: usize, number: u32) {
    bytes[at..at + 4].copy_from_slice(&number.to_le_bytes());
}

/// A manifest with these records, for `signatures` signatures. Bytes 7 to 175 are 0.
pub fn manifest(records: &[u8], signatures: u8) -> Vec<u8> {
    let mut bytes = vec![0; 176];
    bytes.extend(records);
    bytes[..4].copy_from_slice(b"CBS1");
    let size = bytes.len() as u16;
    bytes[4..6].copy_from_slice(&size.to_le_bytes());
    bytes[6] = signatures;
    bytes
}

/// A record of a manifest.
pub fn record(tag: u16, bytes: &[u8]) -> Vec<u8> {
    [&tag.to_le_bytes()[..], &(bytes.len() as u16).to_le_bytes(), bytes].concat()
}

/// A signature with its header; an Ed25519 signature has the algorithm 1 and 64 bytes.
pub fn signature(key_id: u32, algorithm: u16, bytes: &[u8]) -> Vec<u8> {
    let length = bytes.len() as u16;
    [&key_id.to_le_bytes()[..], &algorithm.to_le_bytes(), &length.to_le_bytes(), bytes].concat()
}

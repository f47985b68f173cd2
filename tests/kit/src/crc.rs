//! The CRCs of the protocol, from their definitions.

/// CRC-32/ISO-HDLC from its definition (reflected polynomial EDB88320h), a byte at a time.
pub struct Crc(u32);

const TABLE: [u32; 256] = {
    let mut table = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        let mut crc = byte as u32;
        let mut bit = 0;
        while bit < 8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
            bit += 1;
        }
        table[byte] = crc;
        byte += 1;
    }
    table
};

impl Crc {
    pub fn new() -> Self {
        Self(u32::MAX)
    }

    pub fn push(&mut self, byte: u8) {
        self.0 = TABLE[usize::from(self.0 as u8 ^ byte)] ^ self.0 >> 8;
    }

    pub fn value(&self) -> u32 {
        !self.0
    }
}

pub fn crc32(bytes: &[u8]) -> u32 {
    let mut crc = Crc::new();
    bytes.iter().for_each(|byte| crc.push(*byte));
    crc.value()
}

/// CRC-16/XMODEM (polynomial 1021h, start 0: CiA 301, 7.2.4.3.16), bit by bit.
pub fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0, |crc, byte| {
        let step = |crc: u16, _| crc << 1 ^ if crc & 0x8000 != 0 { 0x1021 } else { 0 };
        (0..8).fold(crc ^ u16::from(*byte) << 8, step)
    })
}

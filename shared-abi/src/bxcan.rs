//! A frame out of the receive FIFO of bxCAN (RM0090 section 32.7.3): bootloader and application read the
//! same of it.

/// The number of data bytes of a classic frame with this data length code: 9 to 15 mean eight, too (ISO
/// 11898-1:2015, table 5). A controller may report the code as it was on the bus.
#[must_use]
pub const fn data_length(dlc: u8) -> usize {
    if dlc < 8 {
        dlc as usize
    } else {
        8
    }
}

/// A CAN data frame with an identifier of 11 bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame {
    id: u16,
    len: u8,
    bytes: [u8; 8],
}

impl Frame {
    /// A frame; `None` for an identifier of more than 11 bits or more than 8 bytes.
    #[must_use]
    pub fn new(id: u16, data: &[u8]) -> Option<Self> {
        let mut bytes = [0; 8];
        bytes.get_mut(..data.len())?.copy_from_slice(data);
        (id < 0x800).then_some(Self { id, len: data.len() as u8, bytes })
    }

    /// The identifier, 0 to 7FFh.
    #[must_use]
    pub const fn id(&self) -> u16 {
        self.id
    }

    /// Its 0 to 8 bytes.
    #[must_use]
    pub fn data(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }

    /// The frame in `CAN_RIxR`, `CAN_RDTxR`, `CAN_RDLxR` and `CAN_RDHxR`; `None` for a remote frame and an
    /// identifier of 29 bits.
    fn received([rir, rdtr, rdlr, rdhr]: [u32; 4]) -> Option<Self> {
        let bytes = (u64::from(rdhr) << 32 | u64::from(rdlr)).to_le_bytes();
        let id = Some((rir >> 21) as u16).filter(|_| rir & (IDE | RTR) == 0)?;
        Self::new(id, &bytes[..data_length(rdtr as u8 & 0xF)])
    }
}

/// Offsets of registers, in words (RM0090 section 32.9.5).
const RF0R: usize = 0x0C / 4;
const RI0R: usize = 0x1B0 / 4;
/// `CAN_RF0R`: the number of frames in the FIFO.
const FMP0: u32 = 0b11;
/// `CAN_RF0R`: the oldest frame has been read. Zeros leave the other bits as they are.
const RFOM0: u32 = 1 << 5;
/// `CAN_RI0R`: an identifier of 29 bits, and a remote frame.
const IDE: u32 = 1 << 2;
const RTR: u32 = 1 << 1;

/// Takes frames from receive FIFO 0 of the controller with these registers, up to the first data frame with
/// an identifier of 11 bits, which it returns; `None` when the FIFO is empty.
///
/// # Safety
/// `registers` is the base of CAN1 or CAN2, which has its clock, and nobody else reads its FIFO 0 meanwhile.
pub unsafe fn receive(registers: *mut u32) -> Option<Frame> {
    // SAFETY: the caller promises the registers, and the offsets are in them. Reading has no effect.
    let read = |offset: usize| unsafe { registers.add(offset).read_volatile() };
    while read(RF0R) & FMP0 != 0 {
        let frame = Frame::received([0, 1, 2, 3].map(|word| read(RI0R + word)));
        // SAFETY: as above. The FIFO is this caller's, and the frame has been read.
        unsafe { registers.add(RF0R).write_volatile(RFOM0) };
        if frame.is_some() {
            return frame;
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// ISO 11898-1:2015, table 5, and RM0090 section 32.9.3.
    #[test]
    fn every_data_length_code_of_the_bus_is_a_frame() {
        for (dlc, len) in (0..=15).zip([0, 1, 2, 3, 4, 5, 6, 7, 8, 8, 8, 8, 8, 8, 8, 8]) {
            // With a time stamp and the index of a filter.
            let received = |rir| Frame::received([rir, 0x1234_5600 | dlc, 0x0506_0708, 0x0102_0304]);
            let data = [8, 7, 6, 5, 4, 3, 2, 1];
            assert_eq!(received(0x601 << 21), Frame::new(0x601, &data[..len]), "{dlc}");
            assert_eq!((received(0x601 << 21 | 2), received(0x601 << 21 | 4)), (None, None), "RTR, 29 bits");
        }
    }
}

//! The bytes of gs_usb: requests, device constants, bit timing and frames. No USB here.
//!
//! Structures and values are those of the Linux driver `drivers/net/can/usb/gs_usb.c`. All numbers
//! are little-endian: the host requests this order, and candleLight always uses it.

use canopen::Frame;
use embedded_can::{Frame as _, Id};

use crate::driven::frame_of;

/// Requests (`enum gs_usb_breq`), vendor type, to the interface.
pub mod request {
    /// `GS_USB_BREQ_HOST_FORMAT`.
    pub const HOST_FORMAT: u8 = 0;
    /// `GS_USB_BREQ_BITTIMING`; the value is the channel.
    pub const BIT_TIMING: u8 = 1;
    /// `GS_USB_BREQ_MODE`; the value is the channel.
    pub const MODE: u8 = 2;
    /// `GS_USB_BREQ_BT_CONST`; the value is the channel.
    pub const CONSTANTS: u8 = 4;
    /// `GS_USB_BREQ_DEVICE_CONFIG`.
    pub const DEVICE_CONFIG: u8 = 5;
}

/// `struct gs_host_config`: a number with known bytes, which shows the device the byte order.
pub const LITTLE_ENDIAN: [u8; 4] = 0x0000_BEEF_u32.to_le_bytes();
/// `struct gs_device_mode` with `GS_CAN_MODE_RESET`.
pub const RESET: [u8; 8] = [0; 8];
/// `struct gs_device_mode` with `GS_CAN_MODE_START`, and no flags: classic frames, no time stamps.
pub const START: [u8; 8] = [1, 0, 0, 0, 0, 0, 0, 0];
/// The length of `struct gs_device_config`.
pub const DEVICE_CONFIG: u16 = 12;
/// The length of `struct gs_device_bt_const`.
pub const CONSTANTS: u16 = 40;
/// The length of `struct gs_host_frame` with the data of a classic frame.
pub const FRAME: usize = 20;
/// `echo_id` of a frame that came from the bus.
const FROM_THE_BUS: u32 = 0xFFFF_FFFF;
/// `GS_CAN_FLAG_OVERFLOW` and `GS_CAN_FLAG_FD`.
const FLAG_OVERFLOW: u8 = 0x01;
const FLAG_FD: u8 = 0x02;
/// `CAN_EFF_FLAG`, `CAN_RTR_FLAG` and `CAN_ERR_FLAG` (linux/can.h).
const EXTENDED: u32 = 0x8000_0000;
const REMOTE: u32 = 0x4000_0000;
const ERROR: u32 = 0x2000_0000;

/// The little-endian word at offset `at`.
fn word(bytes: &[u8], at: usize) -> Option<u32> {
    let bytes = bytes.get(at..at.checked_add(4)?)?;
    Some(u32::from_le_bytes(bytes.try_into().ok()?))
}

/// The number of channels of a device (`struct gs_device_config`: `icount` is one less).
pub fn channels(bytes: &[u8]) -> Option<u8> {
    let last = bytes.get(..usize::from(DEVICE_CONFIG))?[3];
    last.checked_add(1)
}

/// The abilities of a device's controller (`struct gs_device_bt_const`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Constants {
    /// The controller's clock in Hz.
    pub clock: u32,
    /// Time segment 1 (propagation and phase 1), in quanta: minimum and maximum.
    pub segment_1: (u32, u32),
    /// Time segment 2, in quanta: minimum and maximum.
    pub segment_2: (u32, u32),
    /// The maximum jump width, in quanta.
    pub jump_most: u32,
    /// The divider of the clock: minimum, maximum and step.
    pub divider: (u32, u32, u32),
}

impl Constants {
    /// Parses the structure; `None` if `bytes` is too short.
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let at = |place: usize| word(bytes, 4 * place);
        // The first word holds the features; this driver needs none of them.
        Some(Self {
            clock: at(1)?,
            segment_1: (at(2)?, at(3)?),
            segment_2: (at(4)?, at(5)?),
            jump_most: at(6)?,
            divider: (at(7)?, at(8)?, at(9)?),
        })
    }

    /// The timing that gives exactly `rate` (bit/s) with the sample point nearest to CANopen's (CiA
    /// 301: 87.5 %; earlier above 500 kbit/s, as in Linux). `None` if no timing gives this rate.
    pub fn timing(&self, rate: u32) -> Option<Timing> {
        let wanted = match rate {
            800_001.. => 750,
            500_001.. => 800,
            _ => 875,
        };
        let most = u64::from(self.segment_1.1) + u64::from(self.segment_2.1) + 1;
        let (least_divider, most_divider, step) = self.divider;
        let mut best: Option<(u32, Timing)> = None;
        // CAN allows 8 to 25 quanta; controllers for CAN FD allow more.
        for quanta in (4..=u32::try_from(most.min(512)).ok()?).rev() {
            let per_second = rate.checked_mul(quanta).filter(|product| *product > 0)?;
            let divider = self.clock / per_second;
            if !self.clock.is_multiple_of(per_second)
                || !(least_divider.max(1)..=most_divider).contains(&divider)
                || !(divider - least_divider.max(1)).is_multiple_of(step.max(1))
            {
                continue;
            }
            // The sample point follows the synchronisation quantum and segment 1.
            let ideal = quanta - (quanta * wanted + 500) / 1000;
            let behind_least = self.segment_2.0.max(1).max((quanta - 1).saturating_sub(self.segment_1.1));
            let behind_most = self.segment_2.1.min((quanta - 1).saturating_sub(self.segment_1.0.max(1)));
            if behind_least > behind_most {
                continue;
            }
            let segment_2 = ideal.clamp(behind_least, behind_most);
            let segment_1 = quanta - 1 - segment_2;
            let off = (1000 * (1 + segment_1) / quanta).abs_diff(wanted);
            if best.is_none_or(|(least, _)| off < least) {
                let jump = (segment_2 / 2).clamp(1, self.jump_most.max(1));
                best = Some((off, Timing { segment_1, segment_2, jump, divider }));
            }
        }
        best.map(|(_, timing)| timing)
    }
}

/// The timing of a bit, in quanta, and the divider of the clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timing {
    /// Propagation and phase 1.
    pub segment_1: u32,
    /// Phase 2.
    pub segment_2: u32,
    /// The jump width.
    pub jump: u32,
    /// The divider.
    pub divider: u32,
}

impl Timing {
    /// `struct gs_device_bittiming`.
    pub fn emit(&self) -> [u8; 20] {
        let propagation = self.segment_1 / 2;
        let words = [propagation, self.segment_1 - propagation, self.segment_2, self.jump, self.divider];
        let mut bytes = [0; 20];
        for (place, word) in bytes.chunks_exact_mut(4).zip(words) {
            place.copy_from_slice(&word.to_le_bytes());
        }
        bytes
    }
}

/// `struct gs_host_frame` for a frame to send on a channel. The device returns `echo` after it has
/// sent the frame.
pub fn emit(frame: &Frame, channel: u8, echo: u32) -> [u8; FRAME] {
    let mut id = match frame.id() {
        Id::Standard(id) => u32::from(id.as_raw()),
        Id::Extended(id) => id.as_raw() | EXTENDED,
    };
    let mut bytes = [0; FRAME];
    if frame.is_remote_frame() {
        id |= REMOTE;
    } else {
        bytes[12..12 + frame.data().len()].copy_from_slice(frame.data());
    }
    bytes[..4].copy_from_slice(&echo.to_le_bytes());
    bytes[4..8].copy_from_slice(&id.to_le_bytes());
    bytes[8] = frame.dlc() as u8;
    bytes[9] = channel;
    bytes
}

/// A message from a device.
#[derive(Debug, PartialEq, Eq)]
pub enum Transfer {
    /// A frame came from the bus.
    Frame(Frame),
    /// The frame with this echo has been sent.
    Sent(u32),
    /// An error frame: class and data (linux/can/error.h).
    Error(u32, [u8; 8]),
    /// A frame of another channel, or of CAN FD.
    Other,
}

/// Whether a transfer tells that the device has lost frames of the bus.
pub fn has_lost(bytes: &[u8]) -> bool {
    word(bytes, 0) == Some(FROM_THE_BUS) && bytes.get(10).is_some_and(|flags| flags & FLAG_OVERFLOW != 0)
}

/// Parses one transfer.
///
/// # Errors
/// What is wrong with the transfer.
pub fn parse(bytes: &[u8], channel: u8) -> Result<Transfer, String> {
    let short = || format!("a transfer of {} bytes", bytes.len());
    let (echo, id) = (word(bytes, 0).ok_or_else(short)?, word(bytes, 4).ok_or_else(short)?);
    let Some(&[dlc, of, flags, _, ref data @ ..]) = bytes.get(8..FRAME) else { return Err(short()) };
    if of != channel {
        return Ok(Transfer::Other);
    }
    if echo != FROM_THE_BUS {
        return Ok(Transfer::Sent(echo));
    }
    if flags & FLAG_FD != 0 {
        return Ok(Transfer::Other);
    }
    if id & ERROR != 0 {
        let data = data.try_into().map_err(|_| short())?;
        return Ok(Transfer::Error(id & 0x1FFF_FFFF, data));
    }
    frame_of((id & 0x1FFF_FFFF).into(), id & EXTENDED != 0, id & REMOTE != 0, dlc.into(), data)
        .map(Transfer::Frame)
}

#[cfg(test)]
mod tests {
    use embedded_can::ExtendedId;
    use proptest::prelude::*;

    use super::*;
    use crate::tests::frame;

    /// The constants of a candleLight with an STM32F072: tseg1 1..16, tseg2 1..8, sjw 1..4, brp
    /// 1..1024, step 1, clock 48 MHz (its bit timing constants, as `ip -details` shows them).
    const CANDLELIGHT: [u8; 40] = [
        0x53, 0, 0, 0, 0x00, 0x6C, 0xDC, 0x02, 1, 0, 0, 0, 16, 0, 0, 0, 1, 0, 0, 0, 8, 0, 0, 0, 4, 0, 0, 0,
        1, 0, 0, 0, 0, 4, 0, 0, 1, 0, 0, 0,
    ];

    #[test]
    fn constants_are_read_and_give_the_timing_of_the_kernel() {
        let constants = Constants::parse(&CANDLELIGHT).unwrap();
        assert_eq!(constants.clock, 48_000_000);
        assert_eq!(
            (constants.segment_1, constants.segment_2, constants.divider),
            ((1, 16), (1, 8), (1, 1024, 1))
        );
        // `ip -details link show` of such a device at 500 kbit/s: tq 125 prop-seg 6 phase-seg1 7
        // phase-seg2 2 sjw 1, sample-point 0.875.
        let timing = constants.timing(500_000).unwrap();
        assert_eq!(
            timing.emit(),
            [6, 0, 0, 0, 7, 0, 0, 0, 2, 0, 0, 0, 1, 0, 0, 0, 6, 0, 0, 0],
            "prop 6, phase 7, phase 2, jump 1, divider 6"
        );
        for rate in [10_000, 20_000, 50_000, 125_000, 250_000, 500_000, 800_000, 1_000_000] {
            let timing = constants.timing(rate).unwrap();
            assert_eq!(rate * timing.divider * (1 + timing.segment_1 + timing.segment_2), 48_000_000);
        }
        assert_eq!(constants.timing(333_333), None, "it does not divide the clock");
        assert_eq!(Constants::parse(&CANDLELIGHT[..39]), None);
    }

    /// Bytes written by hand from the definition of gs_host_frame.
    #[test]
    fn frames_have_the_drivers_layout() {
        assert_eq!(
            emit(&frame(0x605, &[0x40, 0x00, 0x10]), 0, 7),
            [7, 0, 0, 0, 0x05, 0x06, 0, 0, 3, 0, 0, 0, 0x40, 0x00, 0x10, 0, 0, 0, 0, 0]
        );
        let extended = Frame::new(ExtendedId::new(0x1AAA_AAAA).unwrap(), &[1]).unwrap();
        assert_eq!(emit(&extended, 1, 0)[4..10], [0xAA, 0xAA, 0xAA, 0x9A, 1, 1]);
        let received =
            [0xFF, 0xFF, 0xFF, 0xFF, 0x85, 0x05, 0, 0, 8, 0, 0, 0, 0x43, 0x00, 0x10, 0x00, 0, 0, 0, 0x10];
        let answer = frame(0x585, &[0x43, 0x00, 0x10, 0x00, 0, 0, 0, 0x10]);
        assert_eq!(parse(&received, 0), Ok(Transfer::Frame(answer)));
        assert_eq!(parse(&received, 1), Ok(Transfer::Other));
        // The same with a time stamp at the end.
        assert_eq!(parse(&[&received[..], &[1, 2, 3, 4]].concat(), 0), Ok(Transfer::Frame(answer)));
        let mut echo = received;
        echo[..4].copy_from_slice(&[9, 0, 0, 0]);
        assert_eq!(parse(&echo, 0), Ok(Transfer::Sent(9)));
        // CAN_ERR_FLAG and CAN_ERR_ACK.
        let error = [0xFF, 0xFF, 0xFF, 0xFF, 0x20, 0, 0, 0x20, 8, 0, 0, 0, 0, 0x20, 0, 0, 0, 0, 128, 0];
        assert_eq!(parse(&error, 0), Ok(Transfer::Error(0x20, [0, 0x20, 0, 0, 0, 0, 128, 0])));
        // Any node may send a data length code of 9 to 15, also in a remote frame (ISO 11898-1:2015, table 5).
        for dlc in 9..=15 {
            let mut long = received;
            long[8] = dlc;
            assert_eq!(parse(&long, 0), Ok(Transfer::Frame(answer)), "{dlc}");
            long[7] = 0x40;
            let remote = Frame::new_remote(answer.id(), 8).unwrap();
            assert_eq!(parse(&long, 0), Ok(Transfer::Frame(remote)), "{dlc}");
        }
        assert_eq!(parse(&received[..19], 0), Err("a transfer of 19 bytes".to_string()));
        assert_eq!(parse(&[], 0), Err("a transfer of 0 bytes".to_string()));
        assert_eq!(channels(&[0, 0, 0, 1, 2, 0, 0, 0, 1, 0, 0, 0]), Some(2));
        assert_eq!((channels(&[0, 0, 0]), channels(&[0xFF; 12])), (None, None));
    }

    proptest! {
        #[test]
        fn constants_of_a_device_that_lies_give_a_timing_within_them_or_none(
            words in prop::collection::vec(prop_oneof![0_u32..40, any::<u32>(), Just(48_000_000), Just(u32::MAX)], 10),
            rate in prop_oneof![Just(500_000_u32), Just(10_000), any::<u32>()],
        ) {
            let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
            let constants = Constants::parse(&bytes).unwrap();
            if let Some(timing) = constants.timing(rate) {
                prop_assert!((constants.segment_1.0..=constants.segment_1.1).contains(&timing.segment_1));
                prop_assert!((constants.segment_2.0..=constants.segment_2.1).contains(&timing.segment_2));
                prop_assert_eq!(
                    u64::from(rate) * u64::from(timing.divider) * u64::from(1 + timing.segment_1 + timing.segment_2),
                    u64::from(constants.clock)
                );
            }
        }

        #[test]
        fn any_transfer_is_something_or_named(bytes in prop::collection::vec(any::<u8>(), 0..80), channel in 0_u8..3) {
            let _ = parse(&bytes, channel);
        }

        #[test]
        fn a_frame_comes_back_as_it_went(id in 0_u16..0x800, data in prop::collection::vec(any::<u8>(), 0..9)) {
            let frame = frame(id, &data);
            let mut bytes = emit(&frame, 0, 3);
            bytes[..4].fill(0xFF);
            prop_assert_eq!(parse(&bytes, 0), Ok(Transfer::Frame(frame)));
        }
    }
}

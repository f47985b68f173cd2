//! What an adapter knows about its bus apart from the frames: the state of its controller, and the
//! errors that it sees. This information explains why no node answers.

use std::fmt;

use serde::Serialize;

/// The state of a CAN controller (fault confinement, ISO 11898-1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Controller {
    /// Error active: the controller takes part without limits.
    Active,
    /// An error counter has reached 96.
    Warning,
    /// Error passive: an error counter has reached 128.
    Passive,
    /// Bus-off: the transmit error counter has exceeded 255, and the controller takes no part any
    /// more.
    Off,
    /// Switched off, or in sleep mode.
    Stopped,
}

impl Controller {
    /// The name of the state in messages.
    #[must_use]
    pub const fn words(self) -> &'static str {
        match self {
            Self::Active => "error active",
            Self::Warning => "error warning",
            Self::Passive => "error passive",
            Self::Off => "bus-off",
            Self::Stopped => "switched off",
        }
    }
}

/// What an adapter has seen since it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Health {
    /// The controller's state, if the adapter reports it.
    pub controller: Option<Controller>,
    /// Attempts to send that no other node acknowledged.
    pub unacknowledged: u32,
    /// Bit, stuff, form and CRC errors.
    pub disturbed: u32,
    /// Errors of an unknown kind: socketcand sends the class of an error frame alone.
    pub unclear: u32,
    /// What an adapter has sent that is not of its protocol.
    pub strange: u32,
    /// The tool's own frames have come back, and no others were received.
    pub only_echoes: bool,
    /// The transmit and receive error counters, if the adapter reports them.
    pub counters: Option<(u8, u8)>,
    /// The bit rate in bit/s, where it is known.
    pub bit_rate: Option<u32>,
    /// What did not go through the adapter.
    pub losses: Losses,
}

/// What did not go through an adapter since it was opened. `Display` has what a user should know.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Losses {
    /// Frames that it refused; they were sent again in their order, if it answers each frame.
    pub refused: u32,
    /// Frames that it did not answer, although it answers others; and how often it says that it has lost some.
    pub lost: u32,
    /// Restarts after which its bus was opened again.
    pub restarts: u32,
}

impl Losses {
    /// Those since the time of `before`.
    #[must_use]
    pub const fn since(self, before: Self) -> Self {
        Self {
            refused: self.refused.wrapping_sub(before.refused),
            lost: self.lost.wrapping_sub(before.lost),
            restarts: self.restarts.wrapping_sub(before.restarts),
        }
    }
}

impl fmt::Display for Losses {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let times = |count| if count == 1 { "once".to_string() } else { format!("{count} times") };
        let frames = |count| if count == 1 { "1 frame".to_string() } else { format!("{count} frames") };
        let Self { refused, lost, restarts } = *self;
        let all = [
            (restarts, format!("has restarted {}, and its bus was opened again", times(restarts))),
            (refused, format!("has refused {} (sent again)", frames(refused))),
            (lost, format!("has lost frames, or not answered one, {}", times(lost))),
        ];
        let all: Vec<String> =
            all.into_iter().filter(|(count, _)| *count > 0).map(|(_, words)| words).collect();
        write!(f, "the adapter {}", all.join("; it "))
    }
}

/// The problem of a bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trouble {
    /// The adapter's controller is switched off.
    Stopped,
    /// The adapter's controller is bus-off.
    Off,
    /// Frames are disturbed.
    Disturbed,
    /// No other node acknowledges the adapter's frames.
    Unacknowledged,
    /// The controller is error passive, and the adapter does not report the kind of the errors.
    Passive,
    /// There are errors, and the adapter does not report their kind.
    Unclear,
    /// The adapter has restarted.
    Restarted,
    /// The adapter speaks another protocol than when it was opened.
    Strange,
    /// The server returns the tool's own frames, and nobody else sends any.
    Echo,
}

/// The transmit error counter of a sender without any receiver stays at this value: an error
/// passive sender does not count missing acknowledgements (ISO 11898-1, fault confinement,
/// exception A).
const LONELY: u8 = 128;

/// The classes of errors that need their data: CAN_ERR_CRTL, CAN_ERR_PROT, CAN_ERR_TRX and
/// CAN_ERR_BUSERROR; and CAN_ERR_TX_TIMEOUT, which has none. A lost arbitration is no error.
const UNCLEAR: u32 = 0x04 | 0x08 | 0x10 | 0x80 | 0x01;

impl Health {
    /// The problem of the bus, if there is one.
    #[must_use]
    pub fn trouble(&self) -> Option<Trouble> {
        let passive = self.controller == Some(Controller::Passive);
        match self.controller {
            Some(Controller::Stopped) => Some(Trouble::Stopped),
            Some(Controller::Off) => Some(Trouble::Off),
            // A disturbed frame ends before its acknowledgement. If both errors were seen, the more
            // frequent one is the cause.
            _ if self.disturbed > self.unacknowledged => Some(Trouble::Disturbed),
            _ if self.unacknowledged > 0 => Some(Trouble::Unacknowledged),
            _ if passive
                && self.counters.is_some_and(|(send, receive)| send == LONELY && receive < LONELY) =>
            {
                Some(Trouble::Unacknowledged)
            }
            _ if passive => Some(Trouble::Passive),
            _ if self.unclear > 0 => Some(Trouble::Unclear),
            _ if self.losses.restarts > 0 => Some(Trouble::Restarted),
            _ if self.strange > 0 => Some(Trouble::Strange),
            _ if self.only_echoes => Some(Trouble::Echo),
            _ => None,
        }
    }

    /// Whether other nodes acknowledge the adapter's frames, as far as the adapter reports it.
    #[must_use]
    pub fn acknowledged(&self) -> bool {
        self.controller == Some(Controller::Active) && self.trouble().is_none()
    }

    /// The problem and the advice, as a sentence. `None` if there is no problem, or nothing is
    /// known.
    #[must_use]
    pub fn advice(&self) -> Option<String> {
        let rate = self.bit_rate.map_or(String::new(), |rate| format!(" (the adapter has {})", Rate(rate)));
        Some(match self.trouble()? {
            Trouble::Stopped => {
                "the adapter's CAN controller is switched off: switch the interface on (sudo ip link set can0 up, with \
                 its name in place of can0)"
                    .to_string()
            }
            Trouble::Off => format!(
                "the adapter is bus-off: all its frames were disturbed, for example by a wrong bit rate{rate} or a short circuit \
                 between CAN-H and CAN-L; check both, then switch the adapter off and on (sudo ip link set can0 down, \
                 then up, with its interface's name in place of can0)"
            ),
            Trouble::Disturbed => format!(
                "frames on the bus are disturbed ({} bit, stuff, form or CRC errors): the bit rate is wrong{rate}, or a \
                 terminator is missing; the others' bit rate must be the adapter's",
                self.disturbed
            ),
            Trouble::Unacknowledged => format!(
                "no other node acknowledges the adapter's frames; check that the device has \
                 power, that CAN-H, CAN-L and ground are connected and not swapped, and that it is not silent because \
                 its bit rate is another one{rate}"
            ),
            Trouble::Passive => format!(
                "the adapter is error passive: no node acknowledges its frames, or the bit rate is wrong{rate}; check \
                 power, cable, terminators and bit rate"
            ),
            Trouble::Unclear => format!(
                "the adapter has reported {} of the bus, but not which: no other node acknowledges its frames, or the \
                 bit rate is wrong{rate}; check power, cable, terminators and bit rate",
                self.unclear_errors()
            ),
            Trouble::Restarted => format!("{}: check its supply, its cable and the USB hub, and try again", self.losses),
            Trouble::Strange => {
                "the adapter sends what is not of its protocol, and no frames: it was reset, or something else is at this \
                 port or address; unplug it and plug it in again, or check the URL of the bus"
                    .to_string()
            }
            Trouble::Echo => {
                "the server returns our own frames, and no other node has sent any; check the node-ID, that the bus in the URL is \
                 that of the device, and that the device has power"
                    .to_string()
            }
        })
    }

    /// The problem and the advice, if frames of other nodes arrive although it exists.
    #[must_use]
    pub fn disturbance(&self) -> Option<String> {
        match self.trouble() {
            Some(Trouble::Off | Trouble::Disturbed | Trouble::Restarted) => self.advice(),
            Some(Trouble::Unclear) => Some(format!(
                "the adapter has reported {} of the bus: check the bit rate of each node, cable and terminators",
                self.unclear_errors()
            )),
            _ if self.losses != Losses::default() => Some(self.losses.to_string()),
            _ => None,
        }
    }

    /// Notes whether the adapter says that it has lost frames.
    pub(super) fn loses(&mut self, lost: bool) {
        self.losses.lost = self.losses.lost.saturating_add(lost.into());
    }

    fn unclear_errors(&self) -> String {
        match self.unclear {
            1 => "1 error".to_string(),
            count => format!("{count} errors"),
        }
    }

    /// Adds an error frame of Linux (`linux/can/error.h`), the format of SocketCAN and gs_usb: the
    /// bits of the identifier below `CAN_ERR_FLAG`, and the data. Without data (socketcand), the
    /// class alone counts.
    pub fn error_frame(&mut self, class: u32, data: &[u8]) {
        let byte = |at: usize| data.get(at).copied().unwrap_or_default();
        // CAN_ERR_ACK, or CAN_ERR_PROT with the location CAN_ERR_PROT_LOC_ACK.
        let unacknowledged = class & 0x20 != 0 || class & 0x08 != 0 && byte(3) == 0x19;
        // CAN_ERR_PROT with BIT, FORM, STUFF, BIT0 or BIT1, or with the location of a CRC error.
        let disturbed = class & 0x08 != 0 && (byte(2) & 0x1F != 0 || matches!(byte(3), 0x08 | 0x18));
        if unacknowledged {
            self.unacknowledged = self.unacknowledged.saturating_add(1);
        } else if disturbed {
            self.disturbed = self.disturbed.saturating_add(1);
        } else if data.is_empty() && class & UNCLEAR != 0 {
            self.unclear = self.unclear.saturating_add(1);
        }
        // CAN_ERR_CRTL: TX and RX OVERFLOW, TX and RX PASSIVE, TX and RX WARNING, ACTIVE.
        if class & 0x04 != 0 {
            self.loses(byte(1) & 0x03 != 0);
            self.controller = match byte(1) {
                state if state & 0x30 != 0 => Some(Controller::Passive),
                state if state & 0x0C != 0 => Some(Controller::Warning),
                state if state & 0x40 != 0 => Some(Controller::Active),
                _ => self.controller,
            };
        }
        // CAN_ERR_CNT; drivers older than this flag set the counters alone.
        let counts = class & 0x200 != 0 && !data.is_empty();
        if counts || byte(6) != 0 || byte(7) != 0 {
            self.counters = Some((byte(6), byte(7)));
        }
        // CAN_ERR_BUSOFF, CAN_ERR_RESTARTED.
        if class & 0x40 != 0 {
            self.controller = Some(Controller::Off);
        }
        if class & 0x100 != 0 {
            self.controller = Some(Controller::Active);
        }
    }
}

/// A bit rate in kbit/s or Mbit/s.
struct Rate(u32);

impl fmt::Display for Rate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            rate if rate % 1_000_000 == 0 => write!(f, "{} Mbit/s", rate / 1_000_000),
            rate if rate % 1000 == 0 => write!(f, "{} kbit/s", rate / 1000),
            rate => write!(f, "{rate} bit/s"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(frames: &[(u32, [u8; 8])]) -> Health {
        let mut health = Health::default();
        for (class, data) in frames {
            health.error_frame(*class, data);
        }
        health
    }

    /// The bits are those of linux/can/error.h.
    #[test]
    fn error_frames_tell_no_acknowledgement_from_a_wrong_bit_rate() {
        let at = |at: usize, value: u8| {
            let mut data = [0; 8];
            data[at] = value;
            data
        };
        for (frames, trouble) in [
            // CAN_ERR_ACK, as candleLight and flexcan send it; PROT at the ACK slot, as SJA1000
            // sends it.
            (vec![(0x20, [0; 8])], Some(Trouble::Unacknowledged)),
            (vec![(0x88, at(3, 0x19))], Some(Trouble::Unacknowledged)),
            // PROT: BIT 01h, FORM 02h, STUFF 04h, BIT0 08h, BIT1 10h, CRC at 08h.
            (vec![(0x88, at(2, 0x01))], Some(Trouble::Disturbed)),
            (vec![(0x88, at(2, 0x02))], Some(Trouble::Disturbed)),
            (vec![(0x88, at(2, 0x04))], Some(Trouble::Disturbed)),
            (vec![(0x88, at(2, 0x10))], Some(Trouble::Disturbed)),
            (vec![(0x88, at(3, 0x08))], Some(Trouble::Disturbed)),
            (vec![(0x88, at(2, 0x04)), (0x88, at(2, 0x04)), (0x20, [0; 8])], Some(Trouble::Disturbed)),
            // CRTL: TX_PASSIVE 20h, RX_PASSIVE 10h, TX_WARNING 08h, ACTIVE 40h.
            (vec![(0x04, at(1, 0x20))], Some(Trouble::Passive)),
            (vec![(0x04, at(1, 0x10))], Some(Trouble::Passive)),
            (vec![(0x04, at(1, 0x08))], None),
            (vec![(0x04, at(1, 0x20)), (0x04, at(1, 0x40))], None),
            (vec![(0x40, [0; 8])], Some(Trouble::Off)),
            (vec![(0x40, [0; 8]), (0x100, [0; 8])], None),
            // CNT: no node acknowledges, and the counter stays at 128.
            (vec![(0x204, [0, 0x20, 0, 0, 0, 0, 128, 0])], Some(Trouble::Unacknowledged)),
            (vec![(0x204, [0, 0x20, 0, 0, 0, 0, 200, 0])], Some(Trouble::Passive)),
            (vec![], None),
        ] {
            assert_eq!(after(&frames).trouble(), trouble, "{frames:X?}");
        }
        // CRTL: RX_OVERFLOW 01h, TX_OVERFLOW 02h.
        let lost =
            after(&[(0x04, at(1, 0x01)), (0x04, at(1, 0x02)), (0x04, at(1, 0x40)), (0x02, at(1, 0x01))]);
        assert_eq!(
            lost.disturbance().as_deref(),
            Some("the adapter has lost frames, or not answered one, 2 times")
        );
        // Data shorter than those of a driver.
        let mut health = Health::default();
        health.error_frame(0xFFFF_FFFF, &[]);
        assert_eq!(health.trouble(), Some(Trouble::Unacknowledged));
    }

    /// socketcand: the class without the data.
    #[test]
    fn error_frames_without_data_count_by_their_class() {
        let of = |classes: &[u32]| {
            let mut health = Health::default();
            classes.iter().for_each(|class| health.error_frame(*class, &[]));
            health
        };
        for (classes, trouble) in [
            // CRTL, BUSERROR with PROT, TX_TIMEOUT, TRX.
            (&[0x004][..], Some(Trouble::Unclear)),
            (&[0x088], Some(Trouble::Unclear)),
            (&[0x001], Some(Trouble::Unclear)),
            (&[0x010], Some(Trouble::Unclear)),
            // ACK says it all; so do BUSOFF and RESTARTED.
            (&[0x020, 0x004], Some(Trouble::Unacknowledged)),
            (&[0x004, 0x040], Some(Trouble::Off)),
            (&[0x040, 0x100], None),
            // LOSTARB is the normal case on a busy bus; CNT without counters tells nothing.
            (&[0x002], None),
            (&[0x200], None),
            (&[], None),
        ] {
            assert_eq!(of(classes).trouble(), trouble, "{classes:X?}");
            assert_eq!(of(classes).counters, None, "{classes:X?}");
        }
        let advice = of(&[4, 4, 4]).advice().unwrap();
        assert!(advice.contains("3 errors of the bus") && advice.contains("terminators"), "{advice}");
    }

    #[test]
    fn advice_names_the_bit_rate_and_what_to_do() {
        let health = Health { bit_rate: Some(500_000), disturbed: 3, ..Health::default() };
        let advice = health.advice().unwrap();
        assert!(advice.contains("3 bit, stuff") && advice.contains("500 kbit/s"), "{advice}");
        assert_eq!(Health::default().advice(), None);
        assert!(!Health::default().acknowledged());
        assert!(Health { controller: Some(Controller::Active), ..Health::default() }.acknowledged());
    }
}

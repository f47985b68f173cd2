//! CAN over UART, the adapter's end (`bsp::slcan`): the commands in the manuals of Lawicel's CAN232
//! and CANUSB, and invalid ones.

use bsp::slcan::{text_of, Slcan, FRAME_TEXT};
use canopen::Frame;
use embedded_can::{ExtendedId, Frame as _, Id, StandardId};

/// Sends text to an adapter; returns its answers and the frames.
fn say(slcan: &mut Slcan, text: &[u8]) -> (String, Vec<Frame>) {
    let (mut answers, mut frames) = (String::new(), Vec::new());
    for &byte in text {
        if let Some((answer, frame)) = slcan.receive::<Frame>(byte) {
            answers += std::str::from_utf8(answer.text()).expect("ASCII");
            frames.extend(frame);
        }
    }
    (answers, frames)
}

fn closed() -> Slcan {
    let mut slcan = Slcan::new(0xBEEF);
    assert_eq!(say(&mut slcan, b"C\r").0, "\r");
    slcan
}

fn open() -> Slcan {
    let mut slcan = closed();
    assert_eq!(say(&mut slcan, b"S4\rO\r").0, "\r\r");
    slcan
}

fn standard(id: u16) -> Id {
    StandardId::new(id).unwrap().into()
}

fn extended(id: u32) -> Id {
    ExtendedId::new(id).unwrap().into()
}

/// The examples of the CAN232 manual, in both directions.
#[test]
fn frames_are_those_of_the_manual() {
    let frames = [
        ("t10021133\r", "z\r", Frame::new(standard(0x100), &[0x11, 0x33])),
        ("t0200\r", "z\r", Frame::new(standard(0x020), &[])),
        ("T0000010021133\r", "Z\r", Frame::new(extended(0x100), &[0x11, 0x33])),
        ("r1002\r", "z\r", Frame::new_remote(standard(0x100), 2)),
        ("R000001002\r", "Z\r", Frame::new_remote(extended(0x100), 2)),
        (
            "t7FF81122334455667788\r",
            "z\r",
            Frame::new(standard(0x7FF), &[0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88]),
        ),
        (
            "T1FFFFFFF8112233445566ABCD\r",
            "Z\r",
            Frame::new(extended(0x1FFF_FFFF), &[0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0xAB, 0xCD]),
        ),
    ];
    for (text, answer, frame) in frames {
        let frame = frame.unwrap();
        assert_eq!(say(&mut open(), text.as_bytes()), (answer.to_owned(), vec![frame]), "{text:?}");
        let mut said = Vec::new();
        text_of(&frame, |byte| said.push(byte));
        assert_eq!(said, text.as_bytes());
        assert!(said.len() <= FRAME_TEXT);
    }
}

#[test]
fn digits_may_be_small() {
    let frame = Frame::new(extended(0x18AB_CDEF), &[0xFE]).unwrap();
    assert_eq!(say(&mut open(), b"T18abcdef1fe\r"), ("Z\r".to_owned(), vec![frame]));
}

/// The commands and their descriptions in the manuals: some need a closed channel, some an open
/// one.
#[test]
fn commands_are_those_of_the_manual() {
    const BEL: &str = "\x07";
    for (command, to_closed, to_open) in [
        ("S0", "\r", BEL),
        ("S8", "\r", BEL),
        ("S9", BEL, BEL),
        ("S", BEL, BEL),
        ("s031C", "\r", BEL),
        ("s31C", BEL, BEL),
        ("O", "\r", BEL),
        ("L", "\r", BEL),
        ("C", BEL, "\r"),
        ("t10021133", BEL, "z\r"),
        ("T0000010021133", BEL, "Z\r"),
        ("r1002", BEL, "z\r"),
        ("R000001002", BEL, "Z\r"),
        ("F", BEL, "F00\r"),
        ("V", "V1013\r", "V1013\r"),
        ("N", "NBEEF\r", "NBEEF\r"),
        ("Z0", "\r", BEL),
        ("X1", "\r", BEL),
        ("", "\r", "\r"),
        // Time stamps, polling, filters and storing are not supported.
        ("Z1", BEL, BEL),
        ("X0", BEL, BEL),
        ("P", BEL, BEL),
        ("A", BEL, BEL),
        ("M00000000", BEL, BEL),
        ("W1", BEL, BEL),
        ("Q1", BEL, BEL),
    ] {
        let line = format!("{command}\r");
        assert_eq!(say(&mut closed(), line.as_bytes()).0, to_closed, "{command}, closed");
        assert_eq!(say(&mut open(), line.as_bytes()).0, to_open, "{command}, open");
    }
}

#[test]
fn a_channel_that_only_listens_sends_nothing() {
    let mut slcan = closed();
    assert_eq!(say(&mut slcan, b"L\rt10021133\rF\r"), ("\r\x07F00\r".to_owned(), vec![]));
    assert!(slcan.is_heard());
}

/// The device was reset without the host's knowledge: frames pass. Or the host knows it, and opens
/// the channel.
#[test]
fn after_a_reset_the_channel_is_whatever_the_host_thinks() {
    let mut slcan = Slcan::new(1);
    assert!(slcan.is_heard());
    assert_eq!(say(&mut slcan, b"t1000\r").1.len(), 1);
    assert_eq!(say(&mut slcan, b"S4\rO\rO\r").0, "\r\r\x07");
    assert_eq!(say(&mut slcan, b"C\r").0, "\r");
    assert!(!slcan.is_heard());
    assert_eq!(say(&mut slcan, b"C\rt1000\r"), ("\x07\x07".to_owned(), vec![]));
}

#[test]
fn what_is_no_frame_is_refused_and_the_next_line_is_taken() {
    for bad in [
        &b"t"[..],
        b"t10",
        b"t100",
        b"t1009",
        b"t100:",
        b"t10011",
        b"t100111223",
        b"t8000",
        b"tFFF0",
        b"t+100",
        b"t1001+1",
        b"t1001 1",
        b"txyz0",
        b"T200000000",
        b"T1FFFFFF0",
        b"r10021122",
        b"T1FFFFFFF81122334455667788AA",
        b"t100\xC3\xA90",
        b" t1000",
        b"t1000\n",
        b"t10\x0700",
        b"\x00t1000",
        b"t1000t1000",
        b"t601C",
        &[b't'; 1000],
        &[0xFF; 100],
    ] {
        let mut slcan = open();
        let line = [bad, b"\r"].concat();
        assert_eq!(
            say(&mut slcan, &line),
            ("\x07".to_owned(), vec![]),
            "{:?}",
            bad.escape_ascii().to_string()
        );
        assert_eq!(say(&mut slcan, b"t1000\r").0, "z\r", "{:?}", bad.escape_ascii().to_string());
    }
    // The line ends of text files.
    assert_eq!(say(&mut open(), b"\nt1000\r\nt1000\r\n").0, "z\rz\r");
}

/// A mark is where bytes were lost: the halves of two lines must not form one line, and the
/// host gets an error when it asks.
#[test]
fn a_line_with_a_gap_is_refused() {
    let mut slcan = open();
    let (head, tail) = (&b"t60182"[..], &b"F511F0101000000\r"[..]);
    assert_eq!(say(&mut slcan, &[head, tail].concat()).1.len(), 1);
    assert_eq!(say(&mut slcan, &[head, &[bsp::ring::LOST], tail].concat()), ("\x07".to_owned(), vec![]));
    assert_eq!(say(&mut slcan, b"F\rF\r").0, "F08\rF00\r");
}

/// Noise with many line ends and many valid lines in it: each line end gets one answer, and a valid
/// line after it is recognised.
#[test]
fn noise_is_answered_line_by_line() {
    let mut state = 0x9E37_79B9_7F4A_7C15_u64;
    let mut random = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 32) as u8
    };
    let mut slcan = Slcan::new(1);
    for _ in 0..20_000 {
        let kinds = b"tTrRSsOLCFVNZX0123456789ABCDEF\x00\n\xFF";
        let line: Vec<u8> = (0..random() % 40)
            .map(|_| if random() < 8 { random() } else { kinds[usize::from(random()) % kinds.len()] })
            .filter(|byte| *byte != b'\r')
            .chain(*b"\r")
            .collect();
        let (answer, frames) = say(&mut slcan, &line);
        assert!(answer.ends_with(['\r', '\x07']), "{:?}", line.escape_ascii().to_string());
        assert!(answer.matches(['\r', '\x07']).count() == 1 && frames.len() <= 1);
        assert_eq!(frames.is_empty(), !matches!(&*answer, "z\r" | "Z\r"));
        assert_eq!(say(&mut slcan, b"V\r").0, "V1013\r");
    }
}

//! The text protocols of CAN adapters: SLCAN over a line, socketcand over TCP in both directions.
//!
//! Must hold: any bytes, in any pieces, give frames, nothing, or an error, and never an endless
//! wait; a frame survives writing and parsing unchanged.
#![cfg_attr(fuzzing, no_main)]

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::time::Duration;

use canopen::Frame;
use coboot_can::socketcand::{frame_message, parse_frame, parse_send, send_message, Messages};
use coboot_can::{Adapter, Line, Slcan};
use coboot_fuzz::Input;
use embedded_can::Frame as _;

/// A line that gives this text in pieces and then ends; with `echo`, it returns the written text.
#[derive(Default)]
struct Script {
    says: VecDeque<Vec<u8>>,
    echo: bool,
}

impl Read for Script {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let Some(mut piece) = self.says.pop_front() else { return Ok(0) };
        let rest = piece.split_off(piece.len().min(buffer.len()));
        if !rest.is_empty() {
            self.says.push_front(rest);
        }
        buffer[..piece.len()].copy_from_slice(&piece);
        Ok(piece.len())
    }
}

impl Write for Script {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.echo {
            self.says.push_back(bytes.to_vec());
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Line for Script {
    fn set_timeout(&mut self, _: Duration) -> io::Result<()> {
        Ok(())
    }
}

/// A time-out that never passes: the code under test must end by itself.
const FOR_EVER: Duration = Duration::from_secs(3600);

coboot_fuzz::target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let mut pieces = VecDeque::new();
    while let Some(length) = input.byte() {
        // A piece without bytes means the end of a connection, so it comes last.
        pieces.push_back(input.take(usize::from(length) + 1).to_vec());
    }
    pieces.retain(|piece: &Vec<u8>| !piece.is_empty());

    let mut messages = Messages::default();
    for piece in &pieces {
        messages.add(piece);
        while let Ok(Some(message)) = messages.next() {
            for frame in [parse_frame(&message), parse_send(&message)].into_iter().flatten() {
                let inner = |text: String| text.trim_matches(['<', '>']).to_string();
                assert_eq!(parse_send(&inner(send_message(&frame))), Some(frame));
                assert_eq!(parse_frame(&inner(frame_message(&frame, FOR_EVER))), Some(frame));
            }
        }
    }

    let mut adapter = Slcan::opened(Script { says: pieces, echo: false }, "script".into());
    loop {
        match adapter.receive(FOR_EVER) {
            Ok(Some(frame)) => comes_back(&frame),
            Ok(None) => panic!("the time is not over"),
            Err(error) => {
                assert!(!error.to_string().is_empty());
                break;
            }
        }
    }
});

/// The adapter parses what it writes for a frame as the same frame.
fn comes_back(frame: &Frame) {
    assert!(frame.dlc() <= 8);
    let mut echo = Slcan::opened(Script { says: VecDeque::new(), echo: true }, "echo".into());
    echo.send(frame).expect("it takes everything");
    assert_eq!(echo.receive(FOR_EVER).expect("it is there"), Some(*frame));
}

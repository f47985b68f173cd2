//! The debugger interface, frame by frame and with hostile input.

use core::task::Poll;

use canopen::debugger::{Command, Debugged, Debugger, Kind, Stop, COMMAND, DATA, ENTRIES, PIECE};
use canopen::frame::Channel;
use canopen::line::LineEvent;
use canopen::lss::{LssDevice, StoreError};
use canopen::od::Entry;
use canopen::sdo::client::{Block, Config, Download, Step, Transfer, Upload};
use canopen::sdo::SdoError;
use canopen::slave::SlaveDevice;
use canopen::{AbortCode, Address, BitRate, CobId, Frame, NodeId, Objects};
use embedded_can::Frame as _;
use kit::bus::{at, node, request};
use kit::memory::{Model, Target, RAM, ROM, SIZE};
use proptest::collection::vec;
use proptest::prelude::*;

fn run(target: &mut Target, transfer: &mut impl Transfer) -> Result<(), SdoError> {
    run_with(target, transfer, |_, _| ())
}

/// `before` is called with the number of each request, from 0 on.
fn run_with(
    target: &mut Target,
    transfer: &mut impl Transfer,
    before: impl Fn(&mut Target, u32),
) -> Result<(), SdoError> {
    let mut requests = 0;
    loop {
        match transfer.poll(at(0)) {
            Step::Send(frame) => {
                before(target, requests);
                requests += 1;
                target.handle(&frame, 0);
                while let Some(answer) = target.poll(0) {
                    transfer.handle(&answer, at(0));
                }
            }
            Step::Wait(_) => panic!("the transfer stands still"),
            Step::Done(result) => return result,
        }
    }
}

fn write(target: &mut Target, at: Address, data: &[u8]) -> Result<(), AbortCode> {
    aborted(run(target, &mut Download::new(node(), at, data, Config::default())))
}

fn aborted(outcome: Result<(), SdoError>) -> Result<(), AbortCode> {
    outcome.map_err(|error| match error {
        SdoError::Server(code) => code,
        error => panic!("{error:?}"),
    })
}

fn command(target: &mut Target, kind: Kind, address: u32, len: u16) -> Result<(), AbortCode> {
    write(target, COMMAND, &Command { kind, address, len }.emit())
}

fn read(target: &mut Target) -> Result<Vec<u8>, AbortCode> {
    let mut upload = Upload::new(node(), DATA, Vec::new(), Config::default());
    aborted(run(target, &mut upload))?;
    Ok(upload.into_sink())
}

/// 40 25 10 02: the status, expedited (4F: one byte).
fn status(target: &mut Target) -> u8 {
    let answer = target.ask([0x40, 0x25, 0x10, 0x02, 0, 0, 0, 0]);
    assert_eq!(answer[..4], [0x4F, 0x25, 0x10, 0x02]);
    answer[4]
}

/// The bytes of a read command as in the document, in the frames of a segmented download (CiA 301
/// section 7.2.4.3); then its data.
#[test]
fn a_read_frame_by_frame() {
    let mut target = Target::new();
    target.model().ram[0x10..0x14].copy_from_slice(&[0xDE, 0xAD, 0xBE, 0xEF]);
    assert_eq!(status(&mut target), 0);
    for (said, answered) in [
        // Read 4 bytes at 20000010h: 00, reserved, 04 00, 10 00 00 20.
        ([0x21, 0x25, 0x10, 0x01, 8, 0, 0, 0], [0x60, 0x25, 0x10, 0x01, 0, 0, 0, 0]),
        ([0x00, 0x00, 0x00, 0x04, 0x00, 0x10, 0x00, 0x00], [0x20, 0, 0, 0, 0, 0, 0, 0]),
        ([0x1D, 0x20, 0, 0, 0, 0, 0, 0], [0x30, 0, 0, 0, 0, 0, 0, 0]),
        ([0x40, 0x25, 0x10, 0x02, 0, 0, 0, 0], [0x4F, 0x25, 0x10, 0x02, 1, 0, 0, 0]),
        ([0x40, 0x25, 0x10, 0x04, 0, 0, 0, 0], [0x41, 0x25, 0x10, 0x04, 4, 0, 0, 0]),
        ([0x60, 0, 0, 0, 0, 0, 0, 0], [0x07, 0xDE, 0xAD, 0xBE, 0xEF, 0, 0, 0]),
        // The highest sub-index; the reply, which is not implemented.
        ([0x40, 0x25, 0x10, 0x00, 0, 0, 0, 0], [0x4F, 0x25, 0x10, 0x00, 4, 0, 0, 0]),
        ([0x40, 0x25, 0x10, 0x03, 0, 0, 0, 0], [0x80, 0x25, 0x10, 0x03, 0x11, 0x00, 0x09, 0x06]),
    ] {
        assert_eq!(target.ask(said), answered, "to {said:02X?}");
    }
}

#[test]
fn a_write_frame_by_frame() {
    let mut target = Target::new();
    for (said, answered) in [
        // Write 2 bytes at 20000FFEh, the last two of the memory: 01, reserved, 02 00, FE 0F 00 20.
        ([0x21, 0x25, 0x10, 0x01, 8, 0, 0, 0], [0x60, 0x25, 0x10, 0x01, 0, 0, 0, 0]),
        ([0x00, 0x01, 0x00, 0x02, 0x00, 0xFE, 0x0F, 0x00], [0x20, 0, 0, 0, 0, 0, 0, 0]),
        ([0x1D, 0x20, 0, 0, 0, 0, 0, 0], [0x30, 0, 0, 0, 0, 0, 0, 0]),
        ([0x40, 0x25, 0x10, 0x02, 0, 0, 0, 0], [0x4F, 0x25, 0x10, 0x02, 0xFF, 0, 0, 0]),
        // Expedited: 2 bytes of data (2B).
        ([0x2B, 0x25, 0x10, 0x04, 0xA5, 0x5A, 0, 0], [0x60, 0x25, 0x10, 0x04, 0, 0, 0, 0]),
        ([0x40, 0x25, 0x10, 0x02, 0, 0, 0, 0], [0x4F, 0x25, 0x10, 0x02, 0, 0, 0, 0]),
    ] {
        assert_eq!(target.ask(said), answered, "to {said:02X?}");
    }
    assert_eq!(target.model().ram[0xFFE..], [0xA5, 0x5A]);
}

#[test]
fn data_of_another_length_are_refused_and_nothing_is_written() {
    let mut target = Target::new();
    let before = target.model().ram.clone();
    command(&mut target, Kind::Write, RAM, 5).unwrap();
    // 06070013h too low, 06070012h too high; announced by the client (1st, 2nd) or found at the
    // end.
    assert_eq!(write(&mut target, DATA, &[1; 4]), Err(AbortCode(0x0607_0013)));
    assert_eq!(status(&mut target), 2);
    assert_eq!(write(&mut target, DATA, &[1; 6]), Err(AbortCode(0x0607_0012)));
    for (last, abort) in [
        // No size announced (20h); one segment of 4 bytes (07h), or 6 (03h).
        (0x07, [0x80, 0x25, 0x10, 0x04, 0x13, 0x00, 0x07, 0x06]),
        (0x03, [0x80, 0x25, 0x10, 0x04, 0x12, 0x00, 0x07, 0x06]),
    ] {
        assert_eq!(target.ask([0x20, 0x25, 0x10, 0x04, 0, 0, 0, 0])[0], 0x60);
        assert_eq!(target.ask([last, 9, 9, 9, 9, 9, 9, 0]), abort);
        assert_eq!(status(&mut target), 2);
    }
    // Too many bytes, without an announced size: the complete piece before them is not written
    // either.
    command(&mut target, Kind::Write, RAM, PIECE as u16).unwrap();
    assert_eq!(target.ask([0x20, 0x25, 0x10, 0x04, 0, 0, 0, 0])[0], 0x60);
    let answers: Vec<u8> = (0..19).map(|n| target.ask([(n % 2) << 4, 9, 9, 9, 9, 9, 9, 9])[0]).collect();
    assert!(
        answers[..18].iter().all(|answer| answer & 0xE0 == 0x20) && answers[18] == 0x80,
        "{answers:02X?}"
    );
    assert_eq!(target.model().ram, before);
    assert_eq!(target.model().touched, []);
    // A command is still valid.
    command(&mut target, Kind::Write, RAM, 5).unwrap();
    assert_eq!(write(&mut target, DATA, &[1; 6]), Err(AbortCode(0x0607_0012)));
    write(&mut target, DATA, &[7; 5]).unwrap();
    assert_eq!(target.model().ram[..6], [7, 7, 7, 7, 7, before[5]]);
    assert_eq!(status(&mut target), 0);
}

#[test]
fn commands_that_cannot_be_carried_out_are_refused() {
    for (what, bytes, abort) in [
        ("neither read nor write", vec![2, 0, 4, 0, 0, 0, 0, 0x20], 0x0609_0030),
        ("no bytes", vec![0, 0, 0, 0, 0, 0, 0, 0x20], 0x0609_0030),
        ("nothing is there", vec![0, 0, 4, 0, 0, 0, 0, 0x40], 0x0609_0030),
        ("over the end", vec![0, 0, 2, 0, 0xFF, 0x0F, 0, 0x20], 0x0609_0030),
        ("around the end of all addresses", vec![0, 0, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF], 0x0609_0030),
        ("a ROM is written", vec![1, 0, 1, 0, 0xFF, 0xFF, 0xFF, 0x1F], 0x0609_0030),
        ("seven bytes", vec![0, 0, 4, 0, 0, 0, 0], 0x0607_0013),
        ("nine bytes", vec![0, 0, 4, 0, 0, 0, 0, 0x20, 0], 0x0607_0012),
    ] {
        let mut target = Target::new();
        command(&mut target, Kind::Read, RAM, 4).unwrap();
        assert_eq!(write(&mut target, COMMAND, &bytes), Err(AbortCode(abort)), "{what}");
        assert_eq!(status(&mut target), 2, "{what}");
        // The previous command has ended, too: 08000024h, no data; 08000022h, state.
        assert_eq!(read(&mut target), Err(AbortCode(0x0800_0024)), "{what}");
        assert_eq!(write(&mut target, DATA, &[0; 4]), Err(AbortCode(0x0800_0022)), "{what}");
        assert_eq!(target.model().touched, [], "{what}");
    }
}

#[test]
fn a_locked_device_refuses_everything_also_what_was_allowed_before() {
    let mut target = Target::new();
    target.model().locked = true;
    assert_eq!(command(&mut target, Kind::Read, RAM, 4), Err(AbortCode(0x0800_0022)));
    assert_eq!(read(&mut target), Err(AbortCode(0x0800_0022)));
    for kind in [Kind::Read, Kind::Write] {
        target.model().locked = false;
        command(&mut target, kind, RAM, 4).unwrap();
        target.model().locked = true;
        assert_eq!(read(&mut target), Err(AbortCode(0x0800_0022)));
        assert_eq!(write(&mut target, DATA, &[0; 4]), Err(AbortCode(0x0800_0022)));
    }
    assert_eq!(target.model().touched, []);
}

/// A program on the chip can set the protection at any moment; a transfer needs many pieces.
#[test]
fn a_device_that_is_locked_during_a_transfer_gives_and_takes_no_further_piece() {
    const LEN: u16 = 3 * PIECE as u16;
    fn locked_midway(target: &mut Target, transfer: &mut impl Transfer) {
        // 20 requests, of which 19 carry or ask for 7 bytes: 133, of the second piece.
        let outcome = run_with(target, transfer, |target, request| target.model().locked = request >= 20);
        assert_eq!(aborted(outcome), Err(AbortCode(0x0800_0022)));
        assert_eq!(status(target), 2);
        target.model().locked = false;
    }
    let mut target = Target::new();
    command(&mut target, Kind::Read, RAM, LEN).unwrap();
    locked_midway(&mut target, &mut Upload::new(node(), DATA, Vec::new(), Config::default()));
    let read = [RAM, RAM + PIECE as u32].map(|address| (Kind::Read, address, PIECE));
    assert_eq!(target.model().touched, read);

    target.model().touched.clear();
    command(&mut target, Kind::Write, RAM, LEN).unwrap();
    let data = [0; LEN as usize];
    locked_midway(&mut target, &mut Download::new(node(), DATA, &data[..], Config::default()));
    assert_eq!(target.model().touched, [(Kind::Write, RAM, PIECE)]);
}

/// A changing variable can be read repeatedly; a refusal of the memory is reported.
#[test]
fn a_command_is_good_for_many_reads() {
    let mut target = Target::new();
    command(&mut target, Kind::Read, ROM + SIZE - 2, 4).unwrap();
    for n in 0..3 {
        target.model().ram[1] = n;
        let (rom, ram) = (target.model().rom[SIZE as usize - 2..].to_vec(), target.model().ram[..2].to_vec());
        assert_eq!(read(&mut target), Ok([rom, ram].concat()));
    }
    target.model().refuse = Some(AbortCode::LOCAL_CONTROL);
    assert_eq!(read(&mut target), Err(AbortCode::LOCAL_CONTROL));
    assert_eq!(status(&mut target), 2);
    target.model().refuse = None;
    assert!(read(&mut target).is_ok());
    assert_eq!(status(&mut target), 1);
}

/// Byte 3 is the emergency type, "1" for a code breakpoint; bytes 4 to 7 the address (the
/// document's bytes 1 to 5).
#[test]
fn a_stop_is_told_by_an_emergency() {
    let mut target = Target::new();
    target.device.register = 0x81;
    target.device.emergency = Some([0, 0xFF, 0, 1, 2, 3, 4, 5]);
    target.debugger.stopped(Stop::Breakpoint, 0x0801_2344);
    let frame = target.poll(0).unwrap();
    assert_eq!(frame.cob_id().unwrap().get(), 0x85);
    assert_eq!(frame.data(), [0x00, 0x62, 0x81, 0x01, 0x44, 0x23, 0x01, 0x08]);
    // The device's own emergencies are passed on.
    assert_eq!(target.poll(0).unwrap().data(), [0, 0xFF, 0, 1, 2, 3, 4, 5]);
    assert_eq!(target.poll(0), None);
}

/// The second server of a device (1201h) serves the interface, too: without the forwarding, a
/// device with both would not answer a group download.
#[test]
fn the_second_server_of_the_device_answers() {
    let mut target = Target::new();
    let (ask, answer) = (CobId::new(0x6DF).unwrap(), CobId::new(0x681).unwrap());
    let question = Frame::of(ask, &[0x40, 0x25, 0x10, 0x02, 0, 0, 0, 0]);
    target.handle(&question, 0);
    assert_eq!(target.poll(0), None);
    target.device.second = Some(Channel { request: ask, response: answer });
    target.handle(&question, 0);
    assert_eq!(target.poll(0), Some(Frame::of(answer, &[0x4F, 0x25, 0x10, 0x02, 0, 0, 0, 0])));
    // The first server still answers with its own COB-ID.
    assert_eq!(status(&mut target), 0);
}

/// Each piece is read once, and the last read ends with the command's bytes.
#[test]
fn a_read_touches_each_piece_once() {
    let mut target = Target::new();
    let len = 2 * PIECE as u16 + 5;
    command(&mut target, Kind::Read, ROM, len).unwrap();
    assert_eq!(read(&mut target).unwrap(), target.model().rom[..len.into()]);
    let piece = |number: u32, len| (Kind::Read, ROM + number * PIECE as u32, len);
    assert_eq!(target.model().touched, [piece(0, PIECE), piece(1, PIECE), piece(2, 5)]);
    // At the end there is less than was asked for.
    let mut device = target.debugger.attach(&mut target.device);
    assert_eq!(device.upload_data(DATA, u32::from(len) - 2, &mut [0; 7]), Ok(2));
}

/// A client that has missed segments asks for them from an offset in the middle of a piece that is
/// no longer in the buffer.
#[test]
fn a_read_goes_back_into_a_piece() {
    let mut target = Target::new();
    command(&mut target, Kind::Read, ROM, 300).unwrap();
    let expected = target.model().rom[..300].to_vec();
    // Blocks of 40 segments, which are 280 bytes.
    assert_eq!(target.ask([0xA0, 0x25, 0x10, 4, 40, 0, 0, 0])[0] & !4, 0xC2);
    target.handle(&request([0xA3, 0, 0, 0, 0, 0, 0, 0]), 0);
    let segments = |target: &mut Target| -> Vec<[u8; 8]> {
        core::iter::from_fn(|| target.poll(0)).map(|frame| *frame.exactly().unwrap()).collect()
    };
    let first = segments(&mut target);
    assert_eq!((first.len(), &first[39][1..]), (40, &expected[273..280]));
    // Ten have arrived, which are 70 bytes.
    target.handle(&request([0xA2, 10, 40, 0, 0, 0, 0, 0]), 0);
    let again = segments(&mut target);
    assert_eq!((again.len(), &again[0][1..]), (33, &expected[70..77]));
    assert_eq!(&again[8][1..], &expected[126..133], "of two pieces");
    assert_eq!(&again[32][..7], [&[0x80 | 33][..], &expected[294..]].concat());
}

/// The first frame says that it is too long: nothing waits for the data.
#[test]
fn a_size_that_is_not_that_of_the_command_is_refused_at_once() {
    for (size, code) in [(10, 0x12), (8, 0x13)] {
        let mut target = Target::new();
        command(&mut target, Kind::Write, RAM, 9).unwrap();
        let answer = target.ask([0x21, 0x25, 0x10, 4, size, 0, 0, 0]);
        assert_eq!(answer, [0x80, 0x25, 0x10, 4, code, 0x00, 0x07, 0x06], "{size}");
    }
}

#[test]
fn an_abort_of_the_client_is_an_error_of_the_command() {
    let mut target = Target::new();
    command(&mut target, Kind::Write, RAM, 9).unwrap();
    assert_eq!(target.ask([0x21, 0x25, 0x10, 4, 9, 0, 0, 0])[0], 0x60);
    assert_eq!(status(&mut target), 2, "a request for another object ends the download, too");
    assert_eq!(target.ask([0x21, 0x25, 0x10, 4, 9, 0, 0, 0])[0], 0x60);
    target.handle(&request([0x80, 0x25, 0x10, 4, 0, 0, 0, 8]), 0);
    assert_eq!((target.poll(0), status(&mut target)), (None, 2));
}

/// A device that notes what it is asked.
#[derive(Default)]
struct Noted(Vec<&'static str>);

impl Objects for Noted {
    fn entries(&self) -> &'static [Entry] {
        &ENTRIES
    }

    fn read(&mut self, _: Address, _: &mut [u8]) -> Result<usize, AbortCode> {
        Err(AbortCode::NO_DATA)
    }

    fn download_space(&mut self, _: Address, _: bool) -> usize {
        7
    }

    fn download_cancel(&mut self, _: Address) {
        self.0.push("cancel");
    }
}

impl LssDevice for Noted {
    fn has_lss() -> bool {
        false
    }

    fn supports(&mut self, rate: BitRate) -> bool {
        rate == BitRate::K125
    }

    fn store(&mut self, _: Option<NodeId>, _: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        Poll::Pending
    }

    fn stored(&mut self) -> Poll<Result<(), StoreError>> {
        Poll::Ready(Err(StoreError::Failed))
    }
}

impl SlaveDevice for Noted {
    fn line_event(&mut self, _: LineEvent) {
        self.0.push("line");
    }

    fn node_id_changed(&mut self, _: Option<NodeId>) {
        self.0.push("node-ID");
    }
}

#[test]
fn what_is_not_of_the_interface_is_the_devices() {
    type Both<'a> = Debugged<'a, Noted, Model>;
    let mut debugger = Debugger::new(Model::default());
    let mut noted = Noted::default();
    let mut both = debugger.attach(&mut noted);
    let other = Address::new(0x1F50, 1);
    assert!(!Both::has_second_server() && !Both::has_lss());
    assert_eq!(both.download_space(other, false), 7);
    assert_eq!(both.download_space(DATA, false), usize::MAX);
    assert!(both.supports(BitRate::K125) && !both.supports(BitRate::K250));
    assert_eq!(both.store(None, None), Poll::Pending);
    assert_eq!(both.stored(), Poll::Ready(Err(StoreError::Failed)));
    both.download_cancel(other);
    both.line_event(LineEvent::Recovered);
    both.node_id_changed(None);
    assert_eq!(noted.0, ["cancel", "line", "node-ID"]);
}

proptest! {
    /// A write changes exactly the written bytes; a read returns the contents. By segments and by
    /// blocks.
    #[test]
    fn what_is_written_is_read_and_the_rest_stays(
        data in vec(any::<u8>(), 1..4 * PIECE),
        offset in 0_u32..SIZE,
        blocks in any::<bool>(),
    ) {
        let mut target = Target::new();
        let mut expected = target.model().ram.clone();
        let len = data.len() as u16;
        let outcome = command(&mut target, Kind::Write, RAM + offset, len);
        let fits = offset + u32::from(len) <= SIZE;
        prop_assert_eq!(outcome, if fits { Ok(()) } else { Err(AbortCode::INVALID_VALUE) });
        if !fits {
            return Ok(());
        }
        let outcome = if blocks {
            run(&mut target, &mut Download::as_blocks(node(), DATA, &data, Config::default()))
        } else {
            run(&mut target, &mut Download::new(node(), DATA, &data, Config::default()))
        };
        prop_assert_eq!(outcome, Ok(()));
        expected[offset as usize..][..data.len()].copy_from_slice(&data);
        prop_assert!(target.model().ram == expected);

        command(&mut target, Kind::Read, RAM + offset, len).unwrap();
        if blocks {
            let mut upload =
                Upload::as_blocks(node(), DATA, Vec::new(), Config::default(), Block::default());
            prop_assert_eq!(run(&mut target, &mut upload), Ok(()));
            prop_assert_eq!(upload.into_sink(), data);
        } else {
            prop_assert_eq!(read(&mut target).unwrap(), data);
        }
    }

    /// Any commands and any data in any order, complete or aborted: the memory is only accessed
    /// with permission (the model asserts it), and the next command works.
    #[test]
    fn anybody_may_send_anything(
        frames in vec(
            (prop_oneof![Just(0x21_u8), Just(0x20), Just(0x40), Just(0x60), Just(0x70), Just(0x80), Just(0xA0),
                Just(0xA3), Just(0xC2), Just(0xC6), any::<u8>()], 0_u8..6, any::<[u8; 7]>(), any::<bool>()),
            0..200,
        ),
        locked in any::<bool>(),
    ) {
        let mut target = Target::new();
        for (n, (command, sub, noise, lock)) in frames.into_iter().enumerate() {
            let [a, b, c, d, ..] = noise;
            let frame = if sub < 5 {
                [command, 0x25, 0x10, sub, a, b, c, d]
            } else {
                // A segment, usually of a command that could be carried out.
                [command & 0x1F, noise[0] & 1, 0, noise[2], noise[3] & 1, noise[4], noise[5] & 0x1F, 0]
            };
            target.model().locked = locked && lock;
            target.handle(&request(frame), n as u32);
            while target.poll(n as u32).is_some() {}
        }
        target.model().locked = false;
        target.handle(&request([0x80, 0, 0, 0, 0, 0, 0, 8]), 10_000);
        while target.poll(10_000).is_some() {}
        let rom = target.model().rom[..9].to_vec();
        command(&mut target, Kind::Read, ROM, 9).unwrap();
        prop_assert_eq!(read(&mut target).unwrap(), rom);
    }
}

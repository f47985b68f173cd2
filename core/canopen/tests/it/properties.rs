//! Properties of every sequence of frames and every content.

use canopen::nmt::NmtState;
use canopen::node::{Config, NmtPolicy, Node};
use std::cell::RefCell;
use std::collections::VecDeque;

use canopen::sdo::client::{Block, Config as ClientConfig, Download, SdoError, Step, Transfer, Upload};
use canopen::{Address, Frame};
use kit::bus::{at, node, request, Device};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::select;
use proptest::test_runner::RngSeed;

/// Frames of a hostile bus: SDO requests of every command to existing and missing objects, noise,
/// other lengths, and NMT.
fn any_frame() -> impl Strategy<Value = Frame> {
    let known = vec![0x1000_u16, 0x1008, 0x1017, 0x1018, 0x1F50, 0x1F51, 0x2000, 0x2001, 0x2003];
    let index = prop_oneof![9 => select(known), 1 => any::<u16>()];
    let command = (any::<u8>(), index, 0_u8..3, any::<[u8; 4]>()).prop_map(|(command, index, sub, field)| {
        let [low, high] = index.to_le_bytes();
        let [a, b, c, d] = field;
        request([command, low, high, sub, a, b, c, d])
    });
    let noise = any::<[u8; 8]>().prop_map(request);
    let odd = (0_u16..0x800, vec(any::<u8>(), 0..=8))
        .prop_map(|(id, data)| Frame::of(canopen::CobId::new(id).unwrap(), &data));
    let nmt = (any::<u8>(), 0_u8..8).prop_map(|(command, id)| Frame::of(canopen::CobId::NMT, &[command, id]));
    prop_oneof![6 => command, 4 => noise, 1 => odd, 1 => nmt]
}

fn slave() -> (Node, Device) {
    let mut slave = Node::new(node(), Config { nmt: NmtPolicy::StayPreOperational, ..Config::default() });
    let mut device = Device { tells_size: true, ..Device::default() };
    let _ = slave.poll(at(0), &mut device);
    (slave, device)
}

/// Runs a transfer to its end over a wire without losses.
fn run(
    transfer: &mut impl Transfer,
    slave: &mut Node,
    device: &mut Device,
) -> Result<(), canopen::sdo::SdoError> {
    loop {
        match transfer.poll(at(0)) {
            Step::Send(frame) => {
                slave.handle(&frame, at(0), device);
                while let Some(answer) = slave.poll(at(0), device) {
                    transfer.handle(&answer, at(0));
                }
            }
            Step::Wait(_) => panic!("the transfer stands still"),
            Step::Done(result) => return result,
        }
    }
}

const AT: Address = Address::new(0x2000, 0);

/// The effect of the wire on a frame.
#[derive(Clone, Copy, Debug)]
enum Fate {
    Well,
    Lost,
    Doubled,
    /// It arrives after this many later frames.
    Late(u8),
}

fn any_fate() -> impl Strategy<Value = Fate> {
    prop_oneof![
        40 => Just(Fate::Well),
        1 => Just(Fate::Lost),
        1 => Just(Fate::Doubled),
        1 => (1_u8..5).prop_map(Fate::Late),
    ]
}

/// One direction of the wire.
#[derive(Default)]
struct Wire {
    frames: VecDeque<Frame>,
    late: Vec<(u8, Frame)>,
}

impl Wire {
    fn put(&mut self, frame: Frame, fate: Fate) {
        for (behind, _) in &mut self.late {
            *behind -= 1;
        }
        match fate {
            Fate::Well => self.frames.push_back(frame),
            Fate::Lost => {}
            Fate::Doubled => self.frames.extend([frame, frame]),
            Fate::Late(behind) => self.late.push((behind, frame)),
        }
        let due = self.late.iter().filter(|(behind, _)| *behind == 0).map(|(_, frame)| *frame);
        self.frames.extend(due);
        self.late.retain(|(behind, _)| *behind != 0);
    }

    fn take(&mut self, flush: bool) -> Option<Frame> {
        if flush {
            self.frames.extend(self.late.drain(..).map(|(_, frame)| frame));
        }
        self.frames.pop_front()
    }
}

/// Runs a transfer to its end over a wire with these effects, and without effects afterwards.
fn run_lossy(
    transfer: &mut impl Transfer,
    slave: &mut Node,
    device: &mut Device,
    fates: &[Fate],
) -> Result<(), SdoError> {
    // Both directions take the next effect from the same list.
    let fates = RefCell::new(fates.iter().copied());
    let mut next = |_: &Frame| fates.borrow_mut().next().unwrap_or(Fate::Well);
    let mut next_down = |_: &Frame| fates.borrow_mut().next().unwrap_or(Fate::Well);
    run_with(transfer, slave, device, &mut next, &mut next_down)
}

fn run_with(
    transfer: &mut impl Transfer,
    slave: &mut Node,
    device: &mut Device,
    to_server: &mut dyn FnMut(&Frame) -> Fate,
    to_client: &mut dyn FnMut(&Frame) -> Fate,
) -> Result<(), SdoError> {
    let (mut up, mut down) = (Wire::default(), Wire::default());
    let mut now = 0;
    let mut quiet = false;
    let mut outcome = None;
    for _ in 0..100_000 {
        // Delayed frames arrive when nothing else moves.
        let flush = core::mem::replace(&mut quiet, true);
        match transfer.poll(at(now)) {
            Step::Send(frame) => {
                up.put(frame, to_server(&frame));
                quiet = false;
            }
            Step::Wait(_) => {}
            Step::Done(result) => outcome = Some(result),
        }
        if let Some(frame) = up.take(flush) {
            slave.handle(&frame, at(now), device);
            quiet = false;
        }
        if let Some(frame) = slave.poll(at(now), device) {
            down.put(frame, to_client(&frame));
            quiet = false;
        }
        if let Some(frame) = down.take(flush) {
            transfer.handle(&frame, at(now));
            quiet = false;
        }
        // Both sides are idle, and no frame is in transit.
        if let (Some(result), true, true) = (outcome, quiet && flush, slave.is_sdo_idle()) {
            return result;
        }
        if quiet {
            now += 10;
            // The receiver processes the accepted data.
            device.space = device.space.map(|space| space + 50);
        }
    }
    panic!("the transfer never ends");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, rng_seed: RngSeed::Fixed(301), ..ProptestConfig::default() })]

    /// After any previous events, with answers fetched or not, the next correct transfers work.
    #[test]
    fn any_frames_leave_a_server_that_serves(frames in vec((any_frame(), any::<bool>(), 0_u32..400), 0..60)) {
        let (mut slave, mut device) = slave();
        let mut now = 0;
        for (frame, fetch, pause) in frames {
            now += pause;
            slave.handle(&frame, at(now), &mut device);
            if fetch {
                while slave.poll(at(now), &mut device).is_some() {}
            }
        }
        // Without further frames it becomes idle by itself.
        let later = now + 10_000;
        while slave.poll(at(later), &mut device).is_some() {}
        prop_assert!(slave.is_sdo_idle());
        prop_assert!(device.incoming.is_none());
        prop_assert_eq!(slave.state(), NmtState::PreOperational);
        let data: Vec<u8> = (0..100).collect();
        let mut download = Download::new(node(), Address::new(0x2000, 0), &data, ClientConfig::default());
        prop_assert_eq!(run(&mut download, &mut slave, &mut device), Ok(()));
        prop_assert_eq!(&device.domain, &data);
    }

    /// A transfer need not wait for the time-out of the old one, if the client has aborted that
    /// one. (Without an abort, an initiate might be a segment of a block download.)
    #[test]
    fn any_frames_do_not_delay_the_next_transfer(frames in vec(any_frame(), 0..20)) {
        let (mut slave, mut device) = slave();
        for frame in frames {
            slave.handle(&frame, at(0), &mut device);
            while slave.poll(at(0), &mut device).is_some() {}
        }
        slave.handle(&request([0x80, 0, 0, 0, 0, 0, 0, 8]), at(0), &mut device);
        let mut upload = Upload::new(node(), Address::new(0x1008, 0), Vec::new(), ClientConfig::default());
        prop_assert_eq!(run(&mut upload, &mut slave, &mut device), Ok(()));
        prop_assert_eq!(upload.into_sink(), b"coboot bootloader");
    }

    #[test]
    fn any_content_goes_there_and_back(data in vec(any::<u8>(), 0..600), tells_size: bool) {
        let (mut slave, mut device) = slave();
        device.tells_size = tells_size;
        let mut download = Download::new(node(), Address::new(0x2000, 0), &data, ClientConfig::default());
        prop_assert_eq!(run(&mut download, &mut slave, &mut device), Ok(()));
        prop_assert_eq!(&device.domain, &data);
        prop_assert_eq!(download.progress(), data.len() as u32);
        let mut upload = Upload::new(node(), Address::new(0x2000, 0), Vec::new(), ClientConfig::default());
        prop_assert_eq!(run(&mut upload, &mut slave, &mut device), Ok(()));
        prop_assert_eq!(upload.into_sink(), data);
    }

    /// The same as blocks, of every size, with a receiver of any speed.
    #[test]
    fn any_content_goes_there_and_back_as_blocks(
        data in vec(any::<u8>(), 0..3000),
        blksize in 1_u8..=127,
        tells_size: bool,
        space in proptest::option::of(0_usize..300),
    ) {
        let sdo = canopen::sdo::server::Config { blksize, ..Default::default() };
        let mut slave = Node::new(node(), Config { sdo, ..Config::default() });
        let mut device = Device { tells_size, space, ..Device::default() };
        let _ = slave.poll(at(0), &mut device);
        let block = Block { blksize, pst: 0, repeat_ms: 300 };
        let mut download = Download::as_blocks(node(), AT, &data, ClientConfig::default());
        prop_assert_eq!(run_lossy(&mut download, &mut slave, &mut device, &[]), Ok(()));
        prop_assert_eq!(&device.domain, &data);
        prop_assert_eq!(download.progress(), data.len() as u32);
        let mut upload = Upload::as_blocks(node(), AT, Vec::new(), ClientConfig::default(), block);
        prop_assert_eq!(run_lossy(&mut upload, &mut slave, &mut device, &[]), Ok(()));
        prop_assert_eq!(upload.into_sink(), data);
    }

    /// Whatever the wire loses, repeats or delays: a transfer that both sides report as successful
    /// is correct, and late frames change nothing.
    #[test]
    fn no_block_transfer_is_acknowledged_and_wrong(
        data in vec(any::<u8>(), 0..800),
        blksize in 1_u8..=127,
        fates in vec(any_fate(), 0..400),
        tells_size: bool,
        up: bool,
    ) {
        let sdo = canopen::sdo::server::Config { blksize, ..Default::default() };
        let mut slave = Node::new(node(), Config { sdo, ..Config::default() });
        let mut device = Device { tells_size, ..Device::default() };
        let _ = slave.poll(at(0), &mut device);
        let block = Block { blksize, ..Block::default() };
        if up {
            device.domain.clone_from(&data);
            let mut upload = Upload::as_blocks(node(), AT, Vec::new(), ClientConfig::default(), block);
            if run_lossy(&mut upload, &mut slave, &mut device, &fates).is_ok() {
                prop_assert_eq!(upload.into_sink(), data);
            }
        } else {
            let mut download = Download::as_blocks(node(), AT, &data, ClientConfig::default());
            if run_lossy(&mut download, &mut slave, &mut device, &fates).is_ok() {
                prop_assert_eq!(&device.domain, &data);
            }
        }
        prop_assert!(device.incoming.is_none(), "the server is stuck");
    }

    /// The same without blocks. The wire does not delay a frame beyond an answer: CAN never does,
    /// and the toggle bit of the segmented transfer could not detect it.
    #[test]
    fn no_segmented_transfer_is_acknowledged_and_wrong(
        data in vec(any::<u8>(), 0..300),
        fates in vec(any_fate(), 0..100),
        tells_size: bool,
        up: bool,
    ) {
        let fates: Vec<_> = fates.into_iter().map(|fate| if let Fate::Late(_) = fate { Fate::Lost } else { fate }).collect();
        let (mut slave, mut device) = slave();
        device.tells_size = tells_size;
        if up {
            device.domain.clone_from(&data);
            let mut upload = Upload::new(node(), AT, Vec::new(), ClientConfig::default());
            if run_lossy(&mut upload, &mut slave, &mut device, &fates).is_ok() {
                prop_assert_eq!(upload.into_sink(), data);
            }
        } else {
            let mut download = Download::new(node(), AT, &data, ClientConfig::default());
            if run_lossy(&mut download, &mut slave, &mut device, &fates).is_ok() {
                prop_assert_eq!(&device.domain, &data);
            }
        }
        prop_assert!(device.incoming.is_none(), "the server is stuck");
    }

    /// Any segment of a block transfer may be lost, except all segments of a sub-block: the
    /// transfer continues.
    #[test]
    fn lost_segments_are_repeated(data in vec(any::<u8>(), 100..800), lost in vec(2_usize..100, 1..6), up: bool) {
        let (mut slave, mut device) = slave();
        let mut segments = 0;
        let block = Block { blksize: 20, ..Block::default() };
        let sdo = canopen::sdo::server::Config { blksize: 20, ..Default::default() };
        slave = Node::new(slave.id(), Config { sdo, ..Config::default() });
        let _ = slave.poll(at(0), &mut device);
        // Segments have a number and come in sequence; the other frames of the protocol start at
        // 80h. The first segment of a sub-block always arrives.
        let mut fate = |frame: &Frame| {
            let number = frame.exactly::<8>().unwrap()[0] & 0x7F;
            segments += 1;
            if (2..=20).contains(&number) && lost.contains(&segments) { Fate::Lost } else { Fate::Well }
        };
        let end = if up {
            device.domain.clone_from(&data);
            let mut upload = Upload::as_blocks(node(), AT, Vec::new(), ClientConfig::default(), block);
            let end = run_with(&mut upload, &mut slave, &mut device, &mut |_| Fate::Well, &mut fate);
            device.domain = upload.into_sink();
            end
        } else {
            let mut download = Download::as_blocks(node(), AT, &data, ClientConfig::default());
            run_with(&mut download, &mut slave, &mut device, &mut fate, &mut |_| Fate::Well)
        };
        prop_assert_eq!(end, Ok(()));
        prop_assert_eq!(device.domain, data);
    }

    /// A client survives every answer, and ends at its time-out at the latest.
    #[test]
    fn any_answers_leave_a_client_that_ends(answers in vec((any::<[u8; 8]>(), 0_u32..300), 0..40), up: bool, blocks: bool) {
        let mut now = 0;
        let mut drive = |transfer: &mut dyn Transfer| {
            for (bytes, pause) in &answers {
                while let Step::Send(_) = transfer.poll(at(now)) {}
                now += pause;
                transfer.handle(&kit::bus::response(*bytes), at(now));
            }
            // One pause for the repetition of a sub-block, one for the time-out.
            now += 1000;
            while let Step::Send(_) = transfer.poll(at(now)) {}
            now += 1000;
            while let Step::Send(_) = transfer.poll(at(now)) {}
            matches!(transfer.poll(at(now)), Step::Done(_))
        };
        let (config, block) = (ClientConfig::default(), Block::default());
        let ended = match (up, blocks) {
            (true, false) => drive(&mut Upload::new(node(), AT, Vec::new(), config)),
            (false, false) => drive(&mut Download::new(node(), AT, [7; 50], config)),
            (true, true) => drive(&mut Upload::as_blocks(node(), AT, Vec::new(), config, block)),
            (false, true) => drive(&mut Download::as_blocks(node(), AT, [7; 50], config)),
        };
        prop_assert!(ended);
    }
}

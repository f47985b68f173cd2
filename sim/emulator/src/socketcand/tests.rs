//! Real connections to a world with two ports: the server's and a "device" played by hand. Nothing
//! here looks at a clock; loops give up after so many turns.

use super::*;
use crate::time::{Span, Time};

/// Turns of a millisecond or more after which something that should have happened never will.
const TURNS: usize = 20_000;

struct Bench {
    world: World,
    server: Server,
    adapter: PortId,
    device: PortId,
}

impl Bench {
    fn new() -> Self {
        let mut world = World::new();
        let adapter = world.add_host_port(1_000_000);
        let device = world.add_host_port(1_000_000);
        Self { world, server: Server::bind("127.0.0.1:0", "can0").unwrap(), adapter, device }
    }

    fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(self.server.address()).unwrap();
        stream.set_read_timeout(Some(Duration::from_millis(2))).unwrap();
        stream
    }

    /// One turn of the loop that a program with a server has.
    fn turn(&mut self) {
        thread::park_timeout(Duration::from_millis(1));
        self.server.exchange(&mut self.world, self.adapter);
        self.world.run_for(Span::from_millis(1));
        self.server.exchange(&mut self.world, self.adapter);
    }

    /// Turns until the client has got text that ends with `end`; all it got.
    fn expect(&mut self, mut client: &TcpStream, end: &str) -> String {
        let mut text = String::new();
        for _ in 0..TURNS {
            self.turn();
            let mut buffer = [0; 4096];
            match client.read(&mut buffer) {
                Ok(0) => break,
                Ok(len) => text += std::str::from_utf8(&buffer[..len]).unwrap(),
                Err(_) => {}
            }
            if text.ends_with(end) {
                return text;
            }
        }
        panic!("expected … {end}, got {text}");
    }

    fn raw_client(&mut self) -> TcpStream {
        let client = self.connect();
        assert_eq!(self.expect(&client, ">"), "< hi >");
        (&client).write_all(b"< open can0 >").unwrap();
        assert_eq!(self.expect(&client, ">"), "< ok >");
        (&client).write_all(b"< rawmode >").unwrap();
        assert_eq!(self.expect(&client, "< ok >"), "< ok >");
        client
    }

    fn device_frame(&mut self) -> String {
        for _ in 0..TURNS {
            self.turn();
            if let Some((_, frame)) = self.world.receive(self.device) {
                return frame.to_string();
            }
        }
        panic!("no frame came");
    }
}

#[test]
fn frames_go_both_ways() {
    let mut bench = Bench::new();
    let client = bench.raw_client();
    (&client).write_all(b"< send 601 8 40 0 10 0 0 0 0 0 >").unwrap();
    assert_eq!(bench.device_frame(), "601#4000100000000000");
    let frame = Frame::standard(0x581, &[0x43, 0, 0x10, 0, 0, 0, 0, 0x10]).unwrap();
    bench.world.send(bench.device, frame);
    let text = bench.expect(&client, ">");
    assert!(text.starts_with("< frame 581 ") && text.ends_with(" 4300100000000010 >"), "{text}");
    bench.world.send(bench.device, Frame::standard(0x80, &[]).unwrap());
    assert!(bench.expect(&client, ">").ends_with("  >"));
}

#[test]
fn clients_see_each_other_and_not_themselves() {
    let mut bench = Bench::new();
    let (one, other) = (bench.raw_client(), bench.raw_client());
    (&one).write_all(b"< send 123 1 AB >").unwrap();
    let text = bench.expect(&other, ">");
    assert!(text.starts_with("< frame 123 ") && text.ends_with(" AB >"), "{text}");
    (&one).write_all(b"< echo >").unwrap();
    assert_eq!(bench.expect(&one, "< echo >"), "< echo >");
    assert_eq!(bench.server.clients(), 2);
    drop(one);
    for _ in 0..TURNS {
        if bench.server.clients() == 1 {
            break;
        }
        bench.turn();
    }
    assert_eq!(bench.server.clients(), 1);
}

#[test]
fn the_answer_to_rawmode_comes_alone_on_a_busy_bus() {
    let mut bench = Bench::new();
    for n in 0..20_000 {
        let at = Time(n * 500_000_000);
        bench.world.port_mut(bench.device).send(Frame::standard(0x701, &[5]).unwrap(), at);
    }
    let client = bench.connect();
    client.set_read_timeout(None).unwrap();
    // As a client in a thread of its own does it: one read for each answer.
    let reading = thread::spawn(move || {
        let mut buffer = [0; 256];
        let mut texts = Vec::new();
        for request in [&b""[..], b"< open can0 >", b"< rawmode >", b""] {
            (&client).write_all(request).unwrap();
            let len = (&client).read(&mut buffer).unwrap();
            texts.push(String::from_utf8_lossy(&buffer[..len]).into_owned());
        }
        texts
    });
    for _ in 0..TURNS {
        if reading.is_finished() {
            break;
        }
        bench.turn();
    }
    assert!(reading.is_finished(), "the client still waits for an answer");
    let texts = reading.join().unwrap();
    assert_eq!(texts[..3], ["< hi >", "< ok >", "< ok >"]);
    assert!(texts[3].starts_with("< frame 701 "), "{texts:?}");
}

#[test]
fn a_wrong_bus_is_refused_and_the_connection_ends() {
    let mut bench = Bench::new();
    let client = bench.connect();
    (&client).write_all(b"< open can7 >").unwrap();
    let text = bench.expect(&client, "can0 >");
    assert_eq!(text, "< hi >< error there is no bus can7, only can0 >");
    for _ in 0..TURNS {
        bench.turn();
        if matches!((&client).read(&mut [0; 16]), Ok(0)) {
            return;
        }
    }
    panic!("the connection is still there");
}

#[test]
fn rubbish_ends_in_errors_and_the_next_client_is_served() {
    let mut bench = Bench::new();
    let bad = bench.connect();
    let alphabet = b"< send>open can0 rawmode 0123456789abcdef\xFF\0";
    let mut noise = 0x1234_5678_u32;
    let bytes: Vec<u8> = (0..100_000)
        .map(|_| {
            noise ^= noise << 13;
            noise ^= noise >> 17;
            noise ^= noise << 5;
            alphabet[(noise >> 8) as usize % alphabet.len()]
        })
        .collect();
    // It may be cut off for not reading its errors; that is as good as any answer.
    let _ = (&bad).write_all(&bytes);
    let good = bench.raw_client();
    (&good).write_all(b"< send 7FF 0 >").unwrap();
    for _ in 0..TURNS {
        if bench.device_frame() == "7FF#" {
            return;
        }
    }
    panic!("the good client's frame did not come");
}

#[test]
fn who_does_not_read_is_disconnected_and_the_world_goes_on() {
    let mut bench = Bench::new();
    let _lazy = bench.raw_client();
    let frame = Frame::standard(0x701, &[5]).unwrap();
    // Socket buffers take some megabytes first.
    for _ in 0..2_000 {
        for _ in 0..1_000 {
            bench.world.send(bench.device, frame);
        }
        bench.world.run_for(Span::from_millis(70));
        bench.server.exchange(&mut bench.world, bench.adapter);
        if bench.server.clients() == 0 {
            break;
        }
    }
    assert_eq!(bench.server.clients(), 0);
    assert!(bench.server.notices().iter().any(|notice| notice.contains("does not read")));
}

#[test]
fn who_sends_more_than_the_bus_takes_is_slowed_down_and_nothing_is_lost() {
    let mut bench = Bench::new();
    let client = bench.raw_client();
    let sending = thread::spawn(move || {
        for n in 0..3_000_u32 {
            let text = format!("< send 100 4 {:x} {:x} 0 0 >", n & 0xFF, n >> 8);
            (&client).write_all(text.as_bytes()).unwrap();
        }
        client
    });
    let mut next = 0;
    for _ in 0..TURNS {
        bench.turn();
        while let Some((_, frame)) = bench.world.receive(bench.device) {
            assert_eq!(u32::from_le_bytes(frame.data().try_into().unwrap()), next);
            next += 1;
        }
        assert!(bench.world.port_mut(bench.adapter).waiting() <= CREDIT);
        if next == 3_000 {
            break;
        }
    }
    assert_eq!(next, 3_000);
    drop(sending.join().unwrap());
}

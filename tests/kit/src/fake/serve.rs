//! A fake device behind a socketcand server.

use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::thread;
use std::time::{Duration, Instant};

use canopen::Frame;
use coboot_can::Adapter;
use embedded_can::{Frame as _, Id, StandardId};

/// Puts a fake device behind a socketcand server; gives the bus URL. The device is handed back when
/// the client goes.
pub fn serve<A: Adapter + Send + 'static>(mut fake: A) -> (String, thread::JoinHandle<A>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let bus = format!("socketcand://{}/can0", listener.local_addr().unwrap());
    let server = thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.set_nodelay(true).unwrap();
        stream.set_read_timeout(Some(Duration::from_millis(1))).unwrap();
        stream.write_all(b"< hi >").unwrap();
        let mut text = String::new();
        let (mut open, began, origin) = (false, Instant::now(), fake.now());
        loop {
            let mut bytes = [0; 1024];
            match stream.read(&mut bytes) {
                Ok(0) => return fake,
                Ok(len) => text.push_str(std::str::from_utf8(&bytes[..len]).unwrap()),
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
                Err(_) => return fake,
            }
            while let Some(end) = text.find('>') {
                let message: String = text.drain(..=end).collect();
                open |= message.contains("rawmode");
                serve_message(&message, &mut fake, &mut stream);
            }
            // Before that the client takes no frames.
            if !open {
                continue;
            }
            // The devices' time follows the real one.
            while let Ok(Some(frame)) = fake.receive((origin + began.elapsed()).saturating_sub(fake.now())) {
                let Id::Standard(id) = frame.id() else { continue };
                let data: String = frame.data().iter().map(|byte| format!("{byte:02X}")).collect();
                let line = format!("< frame {:03X} 1.000000 {data} >", id.as_raw());
                if stream.write_all(line.as_bytes()).is_err() {
                    return fake;
                }
            }
        }
    });
    (bus, server)
}

fn serve_message(message: &str, fake: &mut impl Adapter, stream: &mut TcpStream) {
    let words: Vec<&str> = message.split_ascii_whitespace().collect();
    if let ["<", "send", id, _, data @ .., ">"] = words.as_slice() {
        let id = StandardId::new(u16::from_str_radix(id, 16).unwrap()).unwrap();
        let data: Vec<u8> = data.iter().map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect();
        fake.send(&Frame::new(id, &data).unwrap()).unwrap();
    } else {
        stream.write_all(b"< ok >").unwrap();
    }
}

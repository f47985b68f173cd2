//! Buses and libraries that replace those of a computer with adapters.

use std::fs;
use std::io::{ErrorKind, Read, Write};
use std::path::PathBuf;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use canopen::Frame;
use coboot_can::Adapter;
use embedded_can::{Frame as _, Id, StandardId};

use kit::folder::Folder;

/// The identifier of a CANopen frame.
pub fn standard(frame: &Frame) -> u16 {
    match frame.id() {
        Id::Standard(id) => id.as_raw(),
        Id::Extended(_) => panic!("CANopen has 11 bits"),
    }
}

/// Lets a device take part in a conversation until the other side goes. `words` cuts what was read
/// into frames for the device; what it answers goes out as `emit` writes it.
pub fn converse<S: Read + Write, A: Adapter>(
    mut stream: S,
    mut fake: A,
    mut words: impl FnMut(&mut Vec<u8>, &mut S) -> Vec<Frame>,
    emit: impl Fn(&Frame) -> Vec<u8>,
) -> A {
    let (began, origin) = (Instant::now(), fake.now());
    let mut text = Vec::new();
    loop {
        let mut bytes = [0; 4096];
        match stream.read(&mut bytes) {
            Ok(0) => return fake,
            Ok(len) => text.extend_from_slice(&bytes[..len]),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            Err(_) => return fake,
        }
        for frame in words(&mut text, &mut stream) {
            fake.send(&frame).unwrap();
        }
        while let Ok(Some(frame)) = fake.receive((origin + began.elapsed()).saturating_sub(fake.now())) {
            if stream.write_all(&emit(&frame)).is_err() {
                return fake;
            }
        }
    }
}

/// `struct can_frame` of the kernel (linux/can.h): identifier, length, padding, eight bytes.
pub fn can_frame(frame: &Frame) -> Vec<u8> {
    let mut bytes = vec![0; 16];
    bytes[..4].copy_from_slice(&u32::from(standard(frame)).to_ne_bytes());
    bytes[4] = frame.dlc() as u8;
    bytes[8..8 + frame.dlc()].copy_from_slice(frame.data());
    bytes
}

/// Compiles a library that stands in for another; gives its path.
#[cfg(unix)]
pub fn library(folder: &Folder, source: &str, name: &str, options: &[&str]) -> String {
    let source = format!("{}/tests/{source}", env!("CARGO_MANIFEST_DIR"));
    let library = folder.path(name);
    let compiled = Command::new("cc")
        .args(["-shared", "-fPIC", "-Wall", "-Werror", "-o", &library, &source, "-ldl"])
        .args(options)
        .status();
    assert!(compiled.expect("cc, which links Rust programs too").success());
    library
}

/// Puts a device behind a Unix socket, on which frames go as `struct can_frame`. Gives the socket's
/// path; the device is handed back when the client goes.
#[cfg(unix)]
pub fn serve<A: Adapter + Send + 'static>(fake: A) -> (PathBuf, thread::JoinHandle<A>) {
    use std::os::unix::net::UnixListener;
    use std::sync::atomic::{AtomicUsize, Ordering};
    static COUNT: AtomicUsize = AtomicUsize::new(0);
    // A Unix socket's name has room for 107 bytes.
    let name = format!("coflash-bus-{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
    let path = std::env::temp_dir().join(name);
    let _ = fs::remove_file(&path);
    let listener = UnixListener::bind(&path).unwrap();
    let gone = path.clone();
    let server = thread::spawn(move || {
        let (stream, _) = listener.accept().unwrap();
        let _ = fs::remove_file(gone);
        stream.set_read_timeout(Some(Duration::from_millis(1))).unwrap();
        let frames = |bytes: &mut Vec<u8>, _: &mut _| {
            let whole = bytes.len() / 16 * 16;
            let frame = |bytes: &[u8]| {
                let id = u32::from_ne_bytes(bytes[..4].try_into().unwrap());
                let id = StandardId::new(u16::try_from(id).unwrap()).unwrap();
                Frame::new(id, &bytes[8..8 + usize::from(bytes[4])]).unwrap()
            };
            bytes.drain(..whole).collect::<Vec<u8>>().chunks_exact(16).map(frame).collect()
        };
        converse(stream, fake, frames, can_frame)
    });
    (path, server)
}

//! The bench for other programs: they access its bus through the socketcand endpoint, or the
//! board's UART through a terminal, in real time.

use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use emulator::pacing::{Pacer, Speed};
use emulator::serial::Serial;
use emulator::socketcand::Server;

use crate::bench::Bench;
use crate::tools;

/// How long a client may take before it counts as hanging, on the wall clock.
const PATIENCE: Duration = Duration::from_secs(300);

/// A bench with an endpoint.
pub struct Endpoint {
    /// The bench.
    pub bench: Bench,
    server: Server,
    serial: Option<Serial>,
    /// Virtual seconds in a second of the wall clock.
    speed: f64,
}

impl Endpoint {
    /// Opens an endpoint on a free port of this computer.
    ///
    /// # Panics
    /// If no port is free.
    pub fn new(bench: Bench) -> Self {
        let server = Server::bind("127.0.0.1:0", "can0").expect("a free port");
        Self { bench, server, serial: None, speed: 1.0 }
    }

    /// The same, in which the board runs so many times slower than real time. A client whose time-outs
    /// are longer by the same factor meets the same device, and the host may be slower by that factor.
    ///
    /// # Panics
    /// If no port is free.
    pub fn slower(bench: Bench, factor: u32) -> Self {
        Self { speed: f64::from(factor).recip(), ..Self::new(bench) }
    }

    /// The same for a board that uses its UART, which is connected to a pseudo-terminal.
    ///
    /// # Panics
    /// If the system provides none.
    #[cfg(unix)]
    pub fn serial(mut bench: Bench) -> Self {
        let usart = bench.usart().instance().name;
        let serial = Serial::terminal(usart).expect("a pseudo-terminal");
        Self { serial: Some(serial), ..Self::new(bench) }
    }

    /// `HOST:PORT` of the endpoint.
    pub fn address(&self) -> String {
        self.server.address().to_string()
    }

    /// Its URL for coflash.
    pub fn url(&self) -> String {
        match &self.serial {
            Some(serial) => format!("slcan:{}@125k", serial.place()),
            None => format!("socketcand://{}/can0", self.address()),
        }
    }

    /// Runs a program, which must succeed; returns what it has printed.
    ///
    /// # Panics
    /// If it fails.
    #[track_caller]
    pub fn succeed(&mut self, command: &mut Command) -> String {
        tools::succeeded(&self.run(command))
    }

    /// Runs a program until it ends; the board runs meanwhile.
    ///
    /// # Panics
    /// If the program does not start, or does not end.
    pub fn run(&mut self, command: &mut Command) -> Output {
        let command = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap_or_else(|error| panic!("{command:?}: {error}"));
        // Other threads read its output, so that it never waits for a full pipe.
        let [out, err] = readers(&mut child);
        let began = Instant::now();
        let mut pacer = Pacer::new(Speed::Times(self.speed), began, self.bench.time());
        let status = loop {
            if let Some(status) = child.try_wait().expect("the child can be asked") {
                break status;
            }
            if began.elapsed() > PATIENCE {
                let _ = child.kill();
                panic!(
                    "{command:?} hangs; it said: {}",
                    String::from_utf8_lossy(&out.join().unwrap_or_default())
                );
            }
            let target = pacer.target(Instant::now(), self.bench.time());
            if target <= self.bench.time() {
                std::thread::park_timeout(Duration::from_micros(500));
            }
            let mut delivered = self.bench.serve(&mut self.server, target);
            if let Some(serial) = &mut self.serial {
                delivered += serial.exchange(self.bench.machine());
            }
            if delivered > 0 {
                pacer.delivered(Instant::now());
            }
        };
        let [stdout, stderr] = [out, err].map(|reader| reader.join().expect("a reader does not panic"));
        Output { status, stdout, stderr }
    }
}

type Reader = std::thread::JoinHandle<Vec<u8>>;

fn readers(child: &mut Child) -> [Reader; 2] {
    fn drain(mut from: impl std::io::Read + Send + 'static) -> Reader {
        std::thread::spawn(move || {
            let mut bytes = Vec::new();
            let _ = from.read_to_end(&mut bytes);
            bytes
        })
    }
    let (out, err) = (child.stdout.take(), child.stderr.take());
    [drain(out.expect("stdout is a pipe")), drain(err.expect("stderr is a pipe"))]
}

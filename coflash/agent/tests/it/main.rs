//! The agent against a server with faults, over real sockets, with devices that only note what they
//! are given. Devices on a bus: sim/node/tests/it/agent.rs.

/// The content of a file of the library's tests.
macro_rules! data {
    ($name:literal) => {
        include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/../core/tests/data/", $name)).as_slice()
    };
}

mod config;
mod package;
mod tls;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use coflash_agent::{
    run, Config, Content, Devices, Ended, Flashed, Message, News, Options, Order, Target, TargetKind, Times,
};
use coflash_core::file::block_file;
use coflash_core::update::Payload;
use kit::folder::Folder;
use kit::hawkbit::{sha256, Action, Fault, File, Server, State};

/// A block file that was made by another program.
const PROGRAM: &[u8] = data!("identity-110.blk");
const ID: &str = "door";

/// The devices: what they were given, and what they answer.
#[derive(Default)]
struct Fake {
    given: Mutex<Vec<(String, u32)>>,
    answers: Mutex<Vec<Flashed>>,
    /// Whether an update waits until this is set.
    busy: Option<Arc<AtomicBool>>,
    silent: bool,
}

impl Fake {
    fn given(&self) -> Vec<(String, u32)> {
        self.given.lock().unwrap().clone()
    }
}

impl Devices for Fake {
    fn attributes(&self, target: &Target) -> Result<Vec<(String, String)>, String> {
        let TargetKind::Device(device) = &target.what else { return Ok(Vec::new()) };
        match self.silent {
            true => Err("it does not answer".to_string()),
            false => Ok(vec![("node".to_string(), device.node.to_string())]),
        }
    }

    fn flash(&self, order: Order<'_>, news: Sender<News>) -> Flashed {
        let crc = match &order.content {
            Content::Program(_, Payload::Program(file)) => file.crc(),
            Content::Program(..) => panic!("a block file"),
            Content::Package(_, package) => package.programs().map(|(_, program)| program.crc()).sum(),
        };
        self.given.lock().unwrap().push((order.target.controller.clone(), crc));
        let _ = news.send(News::Percent(40));
        while self.busy.as_ref().is_some_and(|busy| busy.load(Ordering::Relaxed)) {
            thread::sleep(Duration::from_millis(5));
        }
        let mut answers = self.answers.lock().unwrap();
        match answers.is_empty() {
            true => Flashed::Done(vec!["done in 1.0 s".to_string()]),
            false => answers.remove(0),
        }
    }
}

/// A folder of one test, deleted at its end.
fn folder(test: &str) -> Folder {
    Folder::below(env!("CARGO_TARGET_TMPDIR"), test)
}

/// The action of the device, as the server has it.
fn action(state: &State) -> &Action {
    state.targets[ID].action.as_ref().unwrap()
}

fn file() -> File {
    File::new("program.blk", PROGRAM)
}

fn crc() -> u32 {
    block_file::read(PROGRAM).unwrap().crc()
}

fn config(server: &Server, folder: &Folder, ids: &[&str]) -> Config {
    let mut text = format!("url = '{}'\nbus = 'socketcan:can0'\npoll-least = 1\n", server.url);
    for (number, id) in ids.iter().enumerate() {
        std::fs::write(folder.join(id), format!("t-{id}\n")).unwrap();
        let node = number + 1;
        text += &format!("[[device]]\ncontroller-id = '{id}'\nnode = {node}\ntoken-file = '{id}'\n");
    }
    Config::parse(&text, folder, None, None).unwrap()
}

fn options() -> Options {
    let ms = Duration::from_millis;
    let times = Times::default()
        .backoff_first(ms(10))
        .backoff_most(ms(40))
        .progress(ms(1))
        .silent(ms(1000))
        .request(ms(2000))
        .piece(ms(2000));
    Options::default().once(true).times(times)
}

/// Runs the agent until there is nothing to do; returns its end, and what it said.
fn once(server: &Server, folder: &Folder, fake: &Fake, ids: &[&str]) -> (Ended, String) {
    run_once(&config(server, folder, ids), fake)
}

fn run_once(config: &Config, fake: &Fake) -> (Ended, String) {
    let said = Mutex::new(String::new());
    let tell = |message: &Message| {
        *said.lock().unwrap() += &format!("{}: {}\n", message.controller, message.text);
    };
    let ended = run(config, &options(), fake, &tell).unwrap();
    (ended, said.into_inner().unwrap())
}

/// Devices that are busy until this flag is cleared, and a server with an action for the first.
fn busy() -> (Server, Fake, Arc<AtomicBool>) {
    let (server, busy) = (Server::start(&[ID]), Arc::new(AtomicBool::new(true)));
    server.assign(ID, Action::new(3, &file()));
    (server, Fake { busy: Some(busy.clone()), ..Fake::default() }, busy)
}

#[test]
fn a_deployment_reaches_the_device_and_its_result_the_server() {
    let (server, folder, fake) = (Server::start(&[ID]), folder("good"), Fake::default());
    server.assign(ID, Action::new(3, &file()));
    let (ended, said) = once(&server, &folder, &fake, &[ID]);
    assert_eq!((ended.updated, ended.failed, ended.unserved), (1, 0, 0), "{said}");
    assert_eq!(fake.given(), [(ID.to_string(), crc())]);
    let action = server.action(ID);
    assert_eq!(action.result.as_deref(), Some("success"));
    let executions: Vec<&str> = action.feedback.iter().map(|(execution, _)| execution.as_str()).collect();
    assert_eq!(executions.first(), Some(&"download"));
    assert_eq!(executions.last(), Some(&"closed"));
    assert_eq!(action.details("closed"), "done in 1.0 s");
    assert_eq!(server.state().targets[ID].attributes["node"], "1");
    // The token is nowhere but in the header.
    assert!(!said.contains("t-door"), "{said}");
    let kept = std::fs::read_dir(folder.join("agent-state")).unwrap();
    for file in kept.flatten().filter(|file| file.path().extension().is_some_and(|end| end == "json")) {
        assert!(!std::fs::read_to_string(file.path()).unwrap().contains("t-door"));
    }
    // A second run has nothing to do.
    once(&server, &folder, &fake, &[ID]);
    assert_eq!(fake.given().len(), 1);
}

/// Each attempt brings the same bytes again.
#[test]
fn a_server_that_knows_no_parts_and_breaks_off_is_given_up() {
    let (server, folder, fake) = (Server::start(&[ID]), folder("no-parts"), Fake::default());
    server.assign(ID, Action::new(3, &File { ranges: false, ..file() }));
    server.fault("artifacts", 100, Fault::Cut(400));
    let (ended, said) = once(&server, &folder, &fake, &[ID]);
    assert_eq!((ended.updated, ended.failed), (0, 1), "{said}");
    assert!(said.contains("cannot be fetched: ") && said.contains("(13 attempts)"), "{said}");
    assert!(server.seen("artifacts").len() < 20 && fake.given().is_empty());
}

#[test]
fn a_server_that_lies_about_size_or_hash_flashes_nothing() {
    let folder = folder("lies");
    let longer = File { content: [PROGRAM, b"x"].concat(), ..file() };
    let shorter = File { content: PROGRAM[..PROGRAM.len() - 1].to_vec(), ..file() };
    let mut altered = PROGRAM.to_vec();
    altered[40] ^= 1;
    let garbage = b"this is no firmware".as_slice();
    for (number, (file, words)) in [
        (longer, "has announced"),
        (shorter, "has announced"),
        (File { content: altered, ..file() }, "SHA-256"),
        (File { sha256: None, ..file() }, "no SHA-256"),
        (File { sha256: Some(sha256(b"x")), ..file() }, "SHA-256"),
        (File { size: 1 << 40, ..file() }, "at most"),
        // What is right and no program is refused before the device hears of it, too.
        (File::new("program.blk", garbage), "what to do"),
        (File::new("program.bin", PROGRAM.get(..100).unwrap()), "what to do"),
    ]
    .into_iter()
    .enumerate()
    {
        let (server, fake) = (Server::start(&[ID]), Fake::default());
        server.assign(ID, Action::new(number as u64, &file));
        let (ended, said) = once(&server, &folder, &fake, &[ID]);
        let action = server.action(ID);
        assert_eq!(action.result.as_deref(), Some("failure"), "{number}: {said}");
        assert!(action.details("closed").contains(words), "{number}: {action:?}");
        assert_eq!((ended.failed, fake.given().len()), (1, 0), "{number}");
    }
}

#[test]
fn a_download_goes_on_where_it_was_cut_off() {
    let (folder, length) = (folder("cut"), PROGRAM.len());
    for ranges in [true, false] {
        let (server, fake) = (Server::start(&[ID]), Fake::default());
        server.assign(ID, Action::new(u64::from(ranges), &File { ranges, ..file() }));
        server.fault("artifacts", 1, Fault::Cut(length / 4));
        server.fault("artifacts", 1, Fault::Cut(length / 4));
        let (ended, said) = once(&server, &folder, &fake, &[ID]);
        assert_eq!((ended.updated, fake.given()), (1, vec![(ID.to_string(), crc())]), "{said}");
        let asked: Vec<_> = server.seen("artifacts").into_iter().map(|seen| seen.range).collect();
        let second = Some(format!("bytes={}-", length / 4));
        let third = if ranges { length / 4 * 2 } else { length / 4 };
        assert_eq!(asked, [None, second, Some(format!("bytes={third}-"))]);
    }
}

#[test]
fn faults_of_the_server_are_waited_out() {
    let folder = folder("faults");
    let faults = [
        Fault::Status(500, None),
        Fault::Status(503, Some(1)),
        Fault::Status(429, Some(1)),
        Fault::Close,
        Fault::Cut(10),
        Fault::Body(b"<html>maintenance</html>".to_vec()),
        Fault::Body(vec![b'['; 200_000]),
        Fault::Endless,
        Fault::Slow(Duration::from_millis(2500)),
    ];
    for (number, fault) in faults.into_iter().enumerate() {
        let (server, fake) = (Server::start(&[ID]), Fake::default());
        server.assign(ID, Action::new(number as u64, &file()));
        // Each of these requests goes wrong once.
        for path in ["v1/door", "deploymentBase", "artifacts"] {
            server.fault(path, 1, fault.clone());
        }
        server.fault("feedback", 1, fault.clone());
        let (ended, said) = once(&server, &folder, &fake, &[ID]);
        assert_eq!((ended.updated, ended.unserved), (1, 0), "{fault:?}: {said}");
        assert_eq!(fake.given(), [(ID.to_string(), crc())], "{fault:?}");
        assert_eq!(server.action(ID).result.as_deref(), Some("success"), "{fault:?}: {said}");
    }
}

#[test]
fn one_devices_trouble_does_not_stop_another() {
    let ids = ["one", "two", "three"];
    let (server, folder, fake) = (Server::start(&ids), folder("others"), Fake::default());
    ids.iter().enumerate().for_each(|(id, name)| server.assign(name, Action::new(id as u64, &file())));
    server.fault("v1/one", 1000, Fault::Status(500, None));
    server.fault("v1/three/softwaremodules", 1000, Fault::Status(404, None));
    let (ended, said) = once(&server, &folder, &fake, &ids);
    assert_eq!((ended.updated, ended.failed, ended.unserved), (1, 1, 1), "{said}");
    assert_eq!(fake.given(), [("two".to_string(), crc())]);
    assert!(server.action("three").details("closed").contains("status 404"));
}

#[test]
fn the_token_goes_to_no_other_server() {
    let (server, other) = (Server::start(&[ID]), Server::start(&["cdn"]));
    let (folder, fake) = (folder("token"), Fake::default());
    // The other server has the file, and no device of ours.
    other.assign("cdn", Action::new(1, &file()));
    let elsewhere = format!("{}/files/program.blk", other.url);
    other.fault("/files/", 1, Fault::Redirect("/files/program.blk?again".to_string()));
    for (number, link) in [(1, Some(elsewhere.clone())), (2, None)] {
        server.assign(ID, Action::new(number, &File { link, ..file() }));
        server.fault("artifacts", 1, Fault::Redirect(elsewhere.clone()));
        let (ended, said) = once(&server, &folder, &fake, &[ID]);
        assert_eq!(ended.updated, 1, "{said}");
    }
    let seen = other.seen("/files/");
    assert_eq!(seen.len(), 3);
    assert!(seen.iter().all(|seen| seen.token.is_none()), "{seen:?}");
    assert!(server.seen("/").iter().all(|seen| seen.token.as_deref() == Some("TargetToken t-door")));
    // Messages are not for others at all.
    server.assign(ID, Action::new(3, &file()));
    server.fault("v1/door", 1000, Fault::Redirect(format!("{}/DEFAULT/controller/v1/door", other.url)));
    let (ended, said) = once(&server, &folder, &fake, &[ID]);
    assert_eq!(ended.unserved, 1);
    assert!(said.contains("leads elsewhere"), "{said}");
    assert!(other.seen("controller").is_empty());
}

#[test]
fn redirects_without_end_have_one() {
    let (server, folder, fake) = (Server::start(&[ID]), folder("circle"), Fake::default());
    server.fault("v1/door", 1000, Fault::Redirect(format!("{}/DEFAULT/controller/v1/door", server.url)));
    let (ended, said) = once(&server, &folder, &fake, &[ID]);
    assert_eq!(ended.unserved, 1);
    assert!(said.contains("redirects more than 3 times"), "{said}");
    assert!(server.seen("/").len() < 40);
}

#[test]
fn a_wrong_token_is_said_and_not_shown() {
    let (server, folder, fake) = (Server::start(&[ID]), folder("refused"), Fake::default());
    std::fs::write(folder.join(ID), "wrong-secret").unwrap();
    let text = format!(
        "url = '{}'\nbus = 'socketcan:can0'\n[[device]]\ncontroller-id = 'door'\nnode = 1\ntoken-file = 'door'\n",
        server.url
    );
    let config = Config::parse(&text, &folder, None, None).unwrap();
    let (ended, said) = run_once(&config, &fake);
    assert_eq!(ended.unserved, 1);
    assert!(said.contains("check the token") && !said.contains("wrong-secret"), "{said}");
}

/// Runs the agent in the background until the test has seen what it wants.
fn while_it_runs(server: &Server, folder: &Folder, fake: &Fake, act: impl FnOnce(&AtomicBool)) {
    let cancelled = Arc::new(AtomicBool::new(false));
    let options = options().once(false).cancelled(cancelled.clone());
    let config = config(server, folder, &[ID]);
    thread::scope(|scope| {
        let agent = scope.spawn(|| run(&config, &options, fake, &|_| {}).unwrap());
        act(&cancelled);
        cancelled.store(true, Ordering::Relaxed);
        agent.join().unwrap();
    });
}

#[test]
fn a_cancellation_during_the_update_is_rejected_with_a_reason() {
    let (folder, (server, fake, busy)) = (folder("cancel"), busy());
    while_it_runs(&server, &folder, &fake, |_| {
        server.wait("progress", |state| action(state).progress.contains(&40));
        server.state().targets.get_mut(ID).unwrap().action.as_mut().unwrap().cancelling = true;
        server.wait("a rejection", |state| !action(state).rejected.is_empty());
        busy.store(false, Ordering::Relaxed);
        server.wait("the end", |state| action(state).result.is_some());
    });
    let action = server.action(ID);
    assert_eq!(action.result.as_deref(), Some("success"));
    assert!(action.rejected[0].contains("half a program"), "{:?}", action.rejected);
    assert_eq!(fake.given().len(), 1);
}

#[test]
fn a_cancellation_before_the_update_is_accepted() {
    let (server, folder, fake) = (Server::start(&[ID]), folder("cancel-early"), Fake::default());
    server.assign(ID, Action { window: Some("unavailable"), update: "skip", ..Action::new(3, &file()) });
    once(&server, &folder, &fake, &[ID]);
    assert!(server.action(ID).details("downloaded").contains("maintenance window"));
    assert_eq!(server.seen("artifacts").len(), 1);
    server.state().targets.get_mut(ID).unwrap().action.as_mut().unwrap().cancelling = true;
    once(&server, &folder, &fake, &[ID]);
    assert_eq!(server.action(ID).result.as_deref(), Some("canceled"));
    assert!(fake.given().is_empty());
    // The same file when the window is open: it is here already.
    server.assign(ID, Action { window: Some("available"), ..Action::new(4, &file()) });
    once(&server, &folder, &fake, &[ID]);
    assert_eq!((fake.given().len(), server.seen("artifacts").len()), (1, 1));
}

#[test]
fn a_failure_and_a_silent_device_are_told() {
    let (server, folder) = (Server::start(&[ID]), folder("failure"));
    let lines = vec!["node 1 does not answer [0x60000013]".to_string(), "what to do: look".to_string()];
    let answers = Mutex::new(vec![Flashed::NotNow("the bus is gone".to_string()), Flashed::Failed(lines)]);
    let fake = Fake { answers, silent: true, ..Fake::default() };
    server.assign(ID, Action::new(3, &file()));
    let (ended, said) = once(&server, &folder, &fake, &[ID]);
    let action = server.action(ID);
    assert_eq!((ended.failed, fake.given().len()), (1, 2), "{said}");
    assert!(action.details("proceeding").contains("the bus is gone"), "{action:?}");
    assert_eq!(action.details("closed"), "node 1 does not answer [0x60000013]\nwhat to do: look");
    assert_eq!(action.result.as_deref(), Some("failure"));
    assert!(server.state().targets[ID].attributes.is_empty());
}

#[test]
fn what_was_fetched_is_there_when_the_bus_is_free_again() {
    let (server, folder) = (Server::start(&[ID]), folder("again"));
    let not_now = || Flashed::NotNow("in use".to_string());
    let good = || Flashed::Done(vec!["done".to_string()]);
    let fake = Fake { answers: Mutex::new(vec![good(), not_now(), not_now(), good()]), ..Fake::default() };
    for number in [3, 4] {
        server.assign(ID, Action::new(number, &file()));
        let (ended, said) = once(&server, &folder, &fake, &[ID]);
        assert_eq!((ended.updated, ended.failed), (1, 0), "{said}");
    }
    assert_eq!((fake.given().len(), server.seen("artifacts").len()), (4, 2));
    // What is not needed any more is gone.
    let left = std::fs::read_dir(folder.join("agent-state")).unwrap().flatten().map(|file| file.path());
    assert!(left.into_iter().all(|path| path.extension().is_none_or(|end| end != "part")));
}

#[test]
fn a_bus_that_stays_away_ends_what_is_done_once() {
    let (server, folder) = (Server::start(&[ID]), folder("away"));
    let answers = (0..100).map(|_| Flashed::NotNow("the adapter is gone".to_string())).collect();
    let fake = Fake { answers: Mutex::new(answers), ..Fake::default() };
    server.assign(ID, Action::new(3, &file()));
    let (ended, said) = once(&server, &folder, &fake, &[ID]);
    assert_eq!((ended.updated, ended.failed, ended.unserved), (0, 0, 1), "{said}");
    assert!(fake.given().len() < 10);
    // The server may still want it: nothing has ended.
    assert_eq!(server.action(ID).result, None);
}

/// The update ends while the agent is being ended: its result must not get lost.
#[test]
fn a_result_that_comes_while_the_agent_ends_is_kept() {
    let (folder, (server, fake, busy)) = (folder("ending"), busy());
    while_it_runs(&server, &folder, &fake, |cancelled| {
        server.wait("progress", |state| action(state).progress.contains(&40));
        cancelled.store(true, Ordering::Relaxed);
        busy.store(false, Ordering::Relaxed);
    });
    let (_, said) = once(&server, &folder, &fake, &[ID]);
    assert_eq!(server.action(ID).result.as_deref(), Some("success"), "{said}");
    assert_eq!(fake.given().len(), 1, "{said}");
}

#[test]
fn two_agents_do_not_share_a_folder() {
    let (server, folder, fake) = (Server::start(&[ID]), folder("lock"), Fake::default());
    while_it_runs(&server, &folder, &fake, |_| {
        server.wait("a poll", |state| !state.seen.is_empty());
        let why = run(&config(&server, &folder, &[ID]), &options(), &fake, &|_| {}).unwrap_err();
        assert!(why.to_string().contains("another agent"), "{why}");
    });
}

/// What may have happened to a state file: it is cut off, another's, no text, too large, or a folder.
#[test]
fn a_damaged_state_file_stops_its_device_alone_and_is_named() {
    let ids = ["one", "two"];
    let (server, folder) = (Server::start(&ids), folder("damaged"));
    server.assign("one", Action::new(1, &file()));
    once(&server, &folder, &Fake::default(), &["one"]);
    let state = folder.join("agent-state");
    let record = std::fs::read_dir(&state).unwrap().flatten().map(|file| file.path());
    let record = record.into_iter().find(|path| path.extension().is_some_and(|end| end == "json")).unwrap();
    let good = std::fs::read(&record).unwrap();
    let damages: [&[u8]; 6] = [b"", b"{", b"[1, 2]", b"\xFF\xFE{}", &[b' '; 300_000], b"a folder"];
    for (number, damage) in damages.into_iter().enumerate() {
        std::fs::remove_file(&record).unwrap();
        match damage {
            b"a folder" => std::fs::create_dir(&record).unwrap(),
            damage => std::fs::write(&record, damage).unwrap(),
        }
        ids.iter().for_each(|id| server.assign(id, Action::new(10 + number as u64, &file())));
        let fake = Fake::default();
        let (ended, said) = once(&server, &folder, &fake, &ids);
        assert_eq!((ended.updated, ended.unserved), (1, 1), "{number}: {said}");
        assert_eq!(fake.given(), [("two".to_string(), crc())], "{number}: {said}");
        let line = said.lines().find(|line| line.contains(&record.display().to_string()));
        let line = line.unwrap_or_else(|| panic!("{number}: {said}"));
        assert!(line.starts_with("one: ") && line.contains("delete"), "{number}: {line}");
        assert!(server.seen("v1/one").iter().all(|seen| !seen.path.contains(&format!("/1{number}"))));
    }
    // When it is whole again, or gone, the device is served.
    std::fs::remove_dir(&record).unwrap();
    std::fs::write(&record, good).unwrap();
    let fake = Fake::default();
    once(&server, &folder, &fake, &ids);
    assert_eq!(fake.given(), [("one".to_string(), crc())]);
}

/// A device whose state file is deleted while the agent runs is served without a restart.
#[test]
fn a_state_file_that_is_put_right_is_read_while_the_agent_runs() {
    let (server, folder, fake) = (Server::start(&[ID]), folder("repaired"), Fake::default());
    server.assign(ID, Action::new(3, &file()));
    once(&server, &folder, &Fake::default(), &[ID]);
    let files = std::fs::read_dir(folder.join("agent-state")).unwrap().flatten().map(|file| file.path());
    let record = files.into_iter().find(|path| path.extension().is_some_and(|end| end == "json")).unwrap();
    std::fs::write(&record, "{").unwrap();
    server.assign(ID, Action::new(4, &file()));
    while_it_runs(&server, &folder, &fake, |_| {
        thread::sleep(Duration::from_millis(50));
        assert!(fake.given().is_empty());
        std::fs::remove_file(&record).unwrap();
        server.wait("the end", |state| action(state).result.is_some());
    });
    assert_eq!(fake.given().len(), 1);
}

/// `Location` is a reference to a URI, relative to the one that was asked for (RFC 9110 section
/// 10.2.2, RFC 3986 section 5).
#[test]
fn a_redirect_may_be_relative() {
    let (folder, fake) = (folder("relative"), Fake::default());
    let server = Server::start(&[ID]);
    let host = server.url.strip_prefix("http:").unwrap();
    let (network, absolute) =
        (format!("{host}/files/program.blk"), format!("{}/files/./x/../program.blk?a=/../b", server.url));
    let artifacts = "/DEFAULT/controller/v1/door/softwaremodules/1/artifacts";
    let own = |rest: &str| format!("{artifacts}/{rest}");
    let elsewhere = "/files/program.blk".to_string();
    for (number, (location, asked)) in [
        ("program.blk?2", own("program.blk?2")),
        ("./program.blk?3", own("program.blk?3")),
        ("../artifacts/program.blk?4#here", own("program.blk?4")),
        ("../../../../../../../../../files/program.blk", elsewhere.clone()),
        ("?again", own("program.blk?again")),
        ("/files/program.blk", elsewhere.clone()),
        (&network, elsewhere.clone()),
        (&absolute, format!("{elsewhere}?a=/../b")),
    ]
    .into_iter()
    .enumerate()
    {
        server.assign(ID, Action::new(number as u64, &file()));
        server.fault("artifacts", 1, Fault::Redirect(location.to_string()));
        let before = server.seen("program.blk").len();
        let (ended, said) = once(&server, &folder, &fake, &[ID]);
        assert_eq!((ended.updated, ended.failed), (1, 0), "{location}: {said}");
        let seen: Vec<String> = server.seen("program.blk").into_iter().map(|seen| seen.path).collect();
        assert_eq!(seen[before..], [own("program.blk"), asked], "{location}: {said}");
    }
    // The root resource may move within the server, too.
    server.assign(ID, Action::new(100, &file()));
    server.fault("v1/door", 1, Fault::Redirect("../v1/door".to_string()));
    let (ended, said) = once(&server, &folder, &fake, &[ID]);
    assert_eq!(ended.updated, 1, "{said}");
    assert!(!said.contains("again in") && !said.contains("URL"), "{said}");
    assert!(server.seen("/").iter().all(|seen| !seen.path.split('?').next().unwrap().contains("..")));
}

#[test]
fn a_redirect_to_what_is_no_url_is_said_with_what_to_do() {
    let (server, folder, fake) = (Server::start(&[ID]), folder("no-url"), Fake::default());
    for location in ["ftp://h/x", "http://", "http://user@127.0.0.1/x", "file:///etc/passwd", "a b", "http:x"]
    {
        server.fault("v1/door", 4, Fault::Redirect(location.to_string()));
        let (ended, said) = once(&server, &folder, &fake, &[ID]);
        assert_eq!(ended.unserved, 1, "{location}: {said}");
        assert!(said.contains("redirects to what is no URL of a server"), "{location}: {said}");
    }
}

//! Packages for machines, from a server: what is taken, and from whom. Machines on a bus:
//! sim/node/tests/it/agent.rs.

use coflash_agent::{run, Config, Message};
use coflash_core::file::sealed::SigningKey;
use coflash_core::machine::{make, Entry, Part};
use kit::folder::Folder;
use kit::hawkbit::{Action, File, Server};

use super::{crc, file, folder, options, Fake, PROGRAM};

const ID: &str = "press";

fn key(seed: u8) -> SigningKey {
    SigningKey::from_seed([seed; 32]).unwrap()
}

/// A package with a program for node 5, signed by this root.
fn package(root: Option<&SigningKey>) -> Vec<u8> {
    let entry = Entry {
        name: "valve".to_owned(),
        file: String::new(),
        size: 0,
        sha256: String::new(),
        nodes: vec![5],
        identity: None,
        count: None,
        program: 1,
        dialect: None,
        trial_run: true,
        verify: false,
    };
    let keys: Vec<_> = root.into_iter().map(|root| (root, None)).collect();
    make(None, None, &[Part { entry, bytes: PROGRAM.to_vec() }], &keys).unwrap()
}

/// Runs the agent with this target until there is nothing to do; returns what the server was told at the end,
/// and what the devices were given.
fn reported(server: &Server, folder: &Folder, target: &str, action: Action) -> (String, Vec<(String, u32)>) {
    std::fs::write(folder.join("root.pub"), key(1).public().to_pem()).unwrap();
    std::fs::write(folder.join("token"), format!("t-{ID}\n")).unwrap();
    let text = format!(
        "url = '{}'\nbus = 'socketcan:can0'\npoll-least = 1\n{target}\ncontroller-id = '{ID}'\ntoken-file = 'token'\n",
        server.url
    );
    let config = Config::parse(&text, folder, None, None).unwrap();
    server.assign(ID, action);
    let fake = Fake::default();
    run(&config, &options(), &fake, &|_: &Message| {}).unwrap();
    let action = server.action(ID);
    let details = format!("{}: {}", action.result.clone().unwrap_or_default(), action.details("closed"));
    (details, fake.given())
}

const MACHINE: &str = "[[machine]]\ntrust = ['root.pub']";
const DEVICE: &str = "[[device]]\nnode = 5";

#[test]
fn a_machine_gets_the_package_that_its_root_has_signed() {
    let (server, folder) = (Server::start(&[ID]), folder("package"));
    let artifact = File::new("press.cpk", &package(Some(&key(1))));
    let (details, given) = reported(&server, &folder, MACHINE, Action::new(1, &artifact));
    assert_eq!(given, [(ID.to_string(), crc())], "{details}");
    assert!(details.starts_with("success: "), "{details}");
}

/// A stranger's signature, none, a package that lies, what is no package, and a package for one device: an end
/// that says what to do, and nothing is started.
#[test]
fn what_is_no_package_of_the_machine_is_refused_and_nothing_is_started() {
    let (server, folder) = (Server::start(&[ID]), folder("package-refused"));
    let good = package(Some(&key(1)));
    // The last byte of the program, which lies before the directory.
    let at = good.windows(4).position(|word| word == b"PK\x01\x02").unwrap() - 1;
    let mut altered = good.clone();
    altered[at] ^= 1;
    let cut = good[..good.len() - 1].to_vec();
    let of = |target, name: &str, bytes: &[u8]| (target, File::new(name, bytes));
    let all = [
        (of(MACHINE, "press.cpk", &package(Some(&key(2)))), "signed by a stranger", "0x60000408"),
        (of(MACHINE, "press.cpk", &package(None)), "is not signed", "coflash package --key"),
        (of(MACHINE, "press.cpk", &altered), "has another", "[0x60000"),
        (of(MACHINE, "press.cpk", &cut), "is not a package", "0x60000400"),
        (of(MACHINE, "valve.blk", PROGRAM), "is not a package", "0x60000400"),
        // By its name, and by its bytes.
        (of(DEVICE, "press.cpk", &good), "this target is one device", "[[machine]]"),
        (of(DEVICE, "press.blk", &good), "this target is one device", "[[machine]]"),
        (of(DEVICE, "press.cpk", PROGRAM), "this target is one device", "[[machine]]"),
    ];
    for (number, ((target, artifact), what, more)) in all.into_iter().enumerate() {
        let (details, given) = reported(&server, &folder, target, Action::new(number as u64, &artifact));
        assert_eq!(given, [], "{number}: {details}");
        assert!(details.starts_with("failure: "), "{number}: {details}");
        for words in [what, more, "what to do: "] {
            assert!(details.contains(words), "{number}: {details}");
        }
    }
    // The device itself is served as before.
    let (details, given) = reported(&server, &folder, DEVICE, Action::new(100, &file()));
    assert_eq!(given, [(ID.to_string(), crc())], "{details}");
}

//! The example of the documentation is a configuration.

use coflash_agent::{Config, TargetKind};
use coflash_core::file::sealed::SigningKey;
use kit::folder::Folder;

#[test]
fn the_pages_example_is_a_configuration() {
    let page = include_str!("../../../../docs/agent.md");
    let example = page.split("```toml\n").nth(1).and_then(|block| block.split("```").next()).unwrap();
    // The variables of this process are not this test's own.
    let without_variable =
        example.replace("token-env = \"LIFT_8_DRIVE_TOKEN\"", "token-file = \"gateway.token\"");
    assert_ne!(without_variable, example);
    let folder = Folder::below(std::env::temp_dir(), "coflash-agent-example");
    std::fs::write(folder.join("gateway.token"), "t").unwrap();
    std::fs::write(folder.join("root.pub"), SigningKey::from_seed([1; 32]).unwrap().public().to_pem())
        .unwrap();
    match Config::parse(&without_variable, &folder, None, None) {
        Ok(config) => {
            let machines =
                config.targets.iter().filter(|target| matches!(target.what, TargetKind::Machine(_)));
            assert_eq!((config.targets.len(), machines.count()), (4, 1));
        }
        // The example's server is at https://.
        Err(why) => assert!(!cfg!(feature = "tls") && why.to_string().contains("feature tls"), "{why}"),
    }
}

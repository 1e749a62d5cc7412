//! Tests that the commands in docs/bridge.md run as written. Only names and ports are replaced with those of this
//! machine.

use std::fs;
use std::path::Path;
use std::process::Command;

use crate::bridge;
use crate::testkit::{INT, TestEnv, output};

/// Returns the code blocks of the page in this language.
fn blocks(language: &str) -> Vec<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/bridge.md");
    let page = fs::read_to_string(path).expect("the page is there");
    let begin = format!("```{language}\n");
    page.split(&begin).skip(1).filter_map(|rest| Some(rest.split_once("\n```")?.0.to_owned())).collect()
}

#[test]
fn page_commands_run_without_error() {
    let env = TestEnv::new();
    let [configuration] = &blocks("json5")[..] else { panic!("one configuration") };
    let mut count = 0;
    let (plain, safe) = (crate::address("tcp"), crate::address("tls"));
    let mut running = Vec::new();
    for line in blocks("sh").iter().flat_map(|block| block.lines()) {
        if let Some(words) = line.strip_prefix("openssl ") {
            let output = output(Command::new("openssl").args(words.split(' ')).current_dir(env.path("")));
            let output = output.expect("openssl is installed");
            assert!(output.status.success(), "{line}: {}", String::from_utf8_lossy(&output.stderr));
        } else if let Some(words) = line.strip_prefix("scanhub bridge ") {
            let configured =
                configuration.replace('"', "'").replace(": 'ca", &format!(": '{}/ca", env.path_argument("")));
            let configured = configured.replace(": 'robot", &format!(": '{}/robot", env.path_argument("")));
            let words = words.replace("tcp/0.0.0.0:7447", &plain).replace("tcp/robot:7447", &plain);
            let words = words.replace("tls/0.0.0.0:7447", &safe);
            let words = words.replace("robot.json5", &env.file("robot.json5", configured));
            let place = TestEnv::new();
            running.push((bridge(&place, &words.split(' ').collect::<Vec<_>>()).0, place));
        } else {
            panic!("no test runs {line}");
        }
        count += 1;
    }
    assert!(count > 5, "{count}");
    crate::wait_until_linked(&mut running[1].0);
    for (program, _place) in running {
        let outcome = program.end(INT);
        assert_eq!(outcome.exit_code, Some(0), "{outcome}");
    }
}

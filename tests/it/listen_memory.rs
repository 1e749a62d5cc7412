//! Memory that strangers on the network can make `scanhub listen --publish` use: topics are made only for gateways that
//! have delivered for a second, and all of them together take no more than `--memory` allows.

use std::time::Duration;

use serde_json::{Value, json};

use crate::testkit::{
    INT, Program, Sender, TestEnv, USR1, in_a_network, is_class, let_pass, number, sequence, shared_memory,
    until,
};
use scanhub_schema::{Contents, Family, MAX_BEAMS, Scan, ScanHead, Topic, Zones};

const HUB: u64 = 0x5f3a_12bc_00d1_e2f3;
const NAME: &str = "--name=robot1=5f3a12bc00d1e2f3";
const INVENTED: u64 = 0xab;

fn publisher(env: &TestEnv, megabytes: u64) -> Program {
    env.start(&["listen", "--json", "--publish", NAME, &format!("--memory={megabytes}")]).ready()
}

/// The longest scan that there can be.
fn longest() -> Box<Scan> {
    let head = ScanHead { contents: Contents::ALL, ..ScanHead::turning(Family::Ld, MAX_BEAMS) };
    Scan::of(head, &vec![1_234; MAX_BEAMS])
}

/// Bytes of all files of the domain in shared memory.
fn used(env: &TestEnv) -> u64 {
    let files = shared_memory(&format!("sh_{}_", env.place().name()));
    files.iter().filter_map(|path| path.metadata().ok()).map(|metadata| metadata.len()).sum()
}

/// The line of this class of the counts that it prints when asked.
fn asked(program: &mut Program, class: &str) -> Value {
    program.signal(USR1);
    program.await_line(class, is_class(class))
}

#[test]
fn invented_sensors_stay_within_the_memory() {
    in_a_network("listen_memory::invented_sensors_stay_within_the_memory", || {
        const MEGABYTES: u64 = 24;
        let env = TestEnv::new();
        let mut program = publisher(&env, MEGABYTES);
        let topics = [Topic::Scan, Topic::Zones, Topic::Foreground, Topic::Background, Topic::Status];
        let mut front = Sender::new(HUB, 7, 0, "front");
        front.await_published(&mut program, &topics);
        let mut echo = env.echo(&["robot1.front/scan"]);
        let own = Scan::of(ScanHead::lms(361, -90_000, 500, 1, 13), &[2_000; 361]);
        // A sensor that has delivered for a second is never removed for others while it delivers.
        for pause_ms in [1_100, 0] {
            front.send(Topic::Scan, &*own);
            echo.await_line("the true one", is_class("scan"));
            let_pass(Duration::from_millis(pause_ms));
        }

        let mut invented = Sender::new(INVENTED, 7, 0, "s0");
        invented.family = Family::Ld;
        invented.await_published(&mut program, &topics);
        let scan = longest();
        let (mut most, mut rounds) = (0, 0);
        until("there is no room", || {
            rounds += 1;
            for number in 0..16 {
                (invented.sensor, invented.name) = (number, format!("s{number}"));
                invented.announce(&topics);
                invented.send(Topic::Scan, &*scan);
                // Waiting for it keeps the flood from overrunning the kernel's buffer.
                front.send(Topic::Scan, &*own);
                echo.await_line("the true one", is_class("scan"));
                most = most.max(used(&env));
            }
            rounds > 2 && number(&asked(&mut program, "lan_published"), "no_room") > 0
        });
        assert!(most > 4 << 20 && most < MEGABYTES << 20, "{most} bytes");

        let echoed = echo.end(INT);
        assert_eq!(echoed.of_class("summary")[0]["missed"], 0, "{echoed}");
        sequence(&echoed.of_class("scan"), "topic_seq");
        let outcome = program.end(INT);
        let published = outcome.of_class("lan_published").pop().expect("the counts");
        assert!(published["sensors"].to_string().contains("robot1.front"), "{published}");
        let last = outcome.of_class("lan_no_room").pop().expect("a gateway");
        assert_eq!((&last["hub"], &last["no_room"]), (&json!("00000000000000ab"), &published["no_room"]));
        let told = |line: &&Value| line["message"].as_str().is_some_and(|text| text.contains("--memory"));
        assert_eq!(outcome.of_class("notice").iter().filter(told).count(), 1, "{outcome}");
        assert!(env.left_behind().is_empty(), "{:?}", env.left_behind());
    });
}

#[test]
fn gateways_without_a_second_of_samples_take_no_memory() {
    in_a_network("listen_memory::gateways_without_a_second_of_samples_take_no_memory", || {
        let env = TestEnv::new();
        let mut program = publisher(&env, 64);
        let mut front = Sender::new(HUB, 7, 0, "front");
        front.await_published(&mut program, &[Topic::Scan]);
        let before = used(&env);
        for n in 0..16 {
            let mut invented = Sender::new(INVENTED + n, 7, 0, "other");
            invented.announce(&Topic::ALL);
            // One sample never covers a second, however busy the machine is.
            invented.send(Topic::Zones, &Zones::unknown());
        }
        until("all samples are counted", || number(&asked(&mut program, "lan_published"), "unproven") == 16);
        assert_eq!(used(&env), before);
        let outcome = program.end(INT);
        let published = outcome.of_class("lan_published").pop().expect("the counts");
        assert_eq!((&published["sensors"], &published["no_room"]), (&json!(["robot1.front"]), &json!(0)));
    });
}

#[test]
fn memory_for_less_than_a_sensor_is_refused() {
    in_a_network("listen_memory::memory_for_less_than_a_sensor_is_refused", || {
        let env = TestEnv::new();
        let outcome = env.run(&["listen", "--json", "--publish", "--memory=2"]);
        let error = &outcome.of_class("error")[0];
        assert_eq!((outcome.code, &error["kind"]), (Some(78), &json!("configuration")), "{outcome}");
        let least = error["hint"].as_str().and_then(|hint| hint.strip_prefix("at least "));
        let least: u64 = least.and_then(|text| text.parse().ok()).unwrap_or_else(|| panic!("{error}"));
        assert_eq!(publisher(&env, least).end(INT).code, Some(0));
        let outcome = env.run(&["listen", "--json", "--publish", &format!("--memory={}", least - 1)]);
        assert_eq!(outcome.code, Some(78), "{outcome}");
    });
}

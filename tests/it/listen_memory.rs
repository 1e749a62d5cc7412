//! Shared memory that unknown senders can make `scanhub listen --publish` use. The listener creates topics only for
//! gateways that have delivered for a second. All its topics together use at most the memory that `--memory` allows.

use std::time::Duration;

use serde_json::{Value, json};

use crate::testkit::{
    INT, Program, TestEnv, TestGateway, USR1, contiguous_numbers, in_a_network, is_class, number,
    shared_memory, wait_at_least, wait_until,
};
use scanhub_schema::{ArrayFlags, Family, MAX_BEAMS, Scan, ScanHead, Topic, Zones};

const HUB_ID: u64 = 0x5f3a_12bc_00d1_e2f3;
const NAME_FLAG: &str = "--name=robot1=5f3a12bc00d1e2f3";
const INVENTED_HUB_ID: u64 = 0xab;

fn publisher(env: &TestEnv, megabytes: u64) -> Program {
    env.start(&["listen", "--json", "--publish", NAME_FLAG, &format!("--memory={megabytes}")]).ready()
}

/// Returns the longest possible scan.
fn longest_scan() -> Box<Scan> {
    let head = ScanHead { contents: ArrayFlags::ALL, ..ScanHead::of_revolution(Family::Ld, MAX_BEAMS) };
    Scan::of(head, &vec![1_234; MAX_BEAMS])
}

/// Returns the total size in bytes of the domain's files in shared memory.
fn used_memory(env: &TestEnv) -> u64 {
    let files = shared_memory(&format!("sh_{}_", env.domain().name()));
    files.iter().filter_map(|path| path.metadata().ok()).map(|metadata| metadata.len()).sum()
}

/// Requests statistics from `program`, and returns the line of class `class`.
fn request_statistics(program: &mut Program, class: &str) -> Value {
    program.signal(USR1);
    program.await_line(class, is_class(class))
}

#[test]
fn invented_sensors_stay_within_the_memory() {
    in_a_network("listen_memory::invented_sensors_stay_within_the_memory", || {
        const MEMORY_LIMIT_MB: u64 = 24;
        let env = TestEnv::new();
        let mut program = publisher(&env, MEMORY_LIMIT_MB);
        let topics = [Topic::Scan, Topic::Zones, Topic::Foreground, Topic::Background, Topic::Status];
        let mut front = TestGateway::new(HUB_ID, 7, 0, "front");
        front.wait_until_published(&mut program, &topics);
        let mut echo = env.echo(&["robot1.front/scan"]);
        let own = Scan::of(ScanHead::lms(361, -90_000, 500, 1, 13), &[2_000; 361]);
        // Prove the sensor: if a sensor has delivered for a second and still delivers, the listener never removes it to
        // make room for others.
        for pause_ms in [1_100, 0] {
            front.send(Topic::Scan, &*own);
            echo.await_line("sample of the genuine sensor", is_class("scan"));
            wait_at_least(Duration::from_millis(pause_ms));
        }

        let mut invented = TestGateway::new(INVENTED_HUB_ID, 7, 0, "s0");
        invented.family = Family::Ld;
        invented.wait_until_published(&mut program, &topics);
        let scan = longest_scan();
        let (mut max_used, mut rounds) = (0, 0);
        wait_until("the listener reports a shortage", || {
            rounds += 1;
            for number in 0..16 {
                (invented.sensor, invented.name) = (number, format!("s{number}"));
                invented.announce(&topics);
                invented.send(Topic::Scan, &*scan);
                // Wait for this sample, so that the datagrams of the flood do not overflow the listener's receive
                // buffer.
                front.send(Topic::Scan, &*own);
                echo.await_line("sample of the genuine sensor", is_class("scan"));
                max_used = max_used.max(used_memory(&env));
            }
            rounds > 2 && number(&request_statistics(&mut program, "lan_published"), "no_room") > 0
        });
        assert!(max_used > 4 << 20 && max_used < MEMORY_LIMIT_MB << 20, "{max_used} bytes");

        let echoed = echo.end(INT);
        assert_eq!(echoed.of_class("summary")[0]["missed"], 0, "{echoed}");
        contiguous_numbers(&echoed.of_class("scan"), "topic_seq");
        let outcome = program.end(INT);
        let published =
            outcome.of_class("lan_published").pop().expect("the statistics have a line of published sensors");
        assert!(published["sensors"].to_string().contains("robot1.front"), "{published}");
        let last = outcome.of_class("lan_no_room").pop().expect("a gateway");
        assert_eq!((&last["hub"], &last["no_room"]), (&json!("00000000000000ab"), &published["no_room"]));
        let reports_limit =
            |line: &&Value| line["message"].as_str().is_some_and(|text| text.contains("--memory"));
        assert_eq!(outcome.of_class("notice").iter().filter(reports_limit).count(), 1, "{outcome}");
        assert!(env.leftover_files().is_empty(), "{:?}", env.leftover_files());
    });
}

#[test]
fn unproven_gateways_take_no_shared_memory() {
    in_a_network("listen_memory::unproven_gateways_take_no_shared_memory", || {
        let env = TestEnv::new();
        let mut program = publisher(&env, 64);
        let mut front = TestGateway::new(HUB_ID, 7, 0, "front");
        front.wait_until_published(&mut program, &[Topic::Scan]);
        let before = used_memory(&env);
        for n in 0..16 {
            let mut invented = TestGateway::new(INVENTED_HUB_ID + n, 7, 0, "other");
            invented.announce(&Topic::ALL);
            // A single sample never proves that a gateway has delivered for a second, even on a busy machine.
            invented.send(Topic::Zones, &Zones::unknown());
        }
        wait_until("all samples are counted", || {
            number(&request_statistics(&mut program, "lan_published"), "unproven") == 16
        });
        assert_eq!(used_memory(&env), before);
        let outcome = program.end(INT);
        let published =
            outcome.of_class("lan_published").pop().expect("the statistics have a line of published sensors");
        assert_eq!((&published["sensors"], &published["no_room"]), (&json!(["robot1.front"]), &json!(0)));
    });
}

#[test]
fn memory_limit_below_one_sensor_is_refused() {
    in_a_network("listen_memory::memory_limit_below_one_sensor_is_refused", || {
        let env = TestEnv::new();
        let outcome = env.run(&["listen", "--json", "--publish", "--memory=2"]);
        let error = &outcome.of_class("error")[0];
        assert_eq!((outcome.exit_code, &error["kind"]), (Some(78), &json!("configuration")), "{outcome}");
        let minimum_text = error["hint"].as_str().and_then(|hint| hint.strip_prefix("at least "));
        let minimum: u64 =
            minimum_text.and_then(|text| text.parse().ok()).unwrap_or_else(|| panic!("{error}"));
        assert_eq!(publisher(&env, minimum).end(INT).exit_code, Some(0));
        let outcome = env.run(&["listen", "--json", "--publish", &format!("--memory={}", minimum - 1)]);
        assert_eq!(outcome.exit_code, Some(78), "{outcome}");
    });
}

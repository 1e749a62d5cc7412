//! Tests with hostile peers. The bridge rejects and counts their input within bounded memory, and still receives from
//! honest peers.

use scanhub_schema::datagram::{HEADER_LEN, Head};
use scanhub_schema::{State, Status, Topic, Verdict, Zones};
use zenoh::{Session, Wait};

use crate::testkit::{INT, Program, TestEnv, TestGateway, number, wait_until};
use crate::{address, bridge, open_peer, refusal_count, wait_until_linked};

const HUB_ID: u64 = 0x5f3a_12bc_00d1_e2f3;
const SENSOR_KEY: &str = "scanhub/5f3a12bc00d1e2f3/front";

fn put(session: &Session, key: &str, bytes: &[u8]) {
    use zenoh::qos::CongestionControl;
    session.put(key, bytes).congestion_control(CongestionControl::Block).wait().expect("it is connected");
}

/// Returns the resident memory of a program in bytes.
fn resident_bytes(program: &Program) -> u64 {
    let text = std::fs::read_to_string(format!("/proc/{}/statm", program.pid())).expect("it lives");
    let pages: u64 = text.split(' ').nth(1).and_then(|word| word.parse().ok()).expect("a number");
    pages * 4096
}

#[test]
fn invalid_datagrams_do_not_block_a_valid_sender() {
    let env = TestEnv::new();
    let at = address("tcp");
    let (mut here, _) = bridge(&env, &["--listen", &at, "--publish", "--name=robot1=5f3a12bc00d1e2f3"]);
    let session = open_peer(&at);
    wait_until_linked(&mut here);
    let mut sender = TestGateway::new(HUB_ID, 7, 0, "front");
    let topics = [Topic::Zones, Topic::Status];
    // Repeat the announcement until the bridge has subscribed.
    wait_until("the sensor is published", || {
        let bytes = sender.announcement(&topics);
        put(&session, &format!("{SENSOR_KEY}/announce"), &bytes);
        here.prints(|line| line["kind"] == "published")
    });
    let status =
        sender.next_datagram(Topic::Status, &Status { state: State::Streaming as u8, ..Status::default() });
    put(&session, &format!("{SENSOR_KEY}/status"), &status);
    let mut echo = env.echo(&["robot1.front/zones"]);
    let zones = |sender: &mut TestGateway, verdict: Verdict| {
        sender.next_datagram(Topic::Zones, &Zones { verdict: verdict as u8, ..Zones::unknown() })
    };
    put(&session, &format!("{SENSOR_KEY}/zones"), &zones(&mut sender, Verdict::Clear));
    echo.await_line("zones", |line| line["class"] == "zones" && line["verdict"] == "clear");
    let before = resident_bytes(&here);

    let good = zones(&mut sender, Verdict::Stop);
    let version = [&good[..4], &[9], &good[5..]].concat();
    let mut broken = good.clone();
    broken[HEADER_LEN] ^= 1;
    let wrong: [(&str, &[u8], &str); 8] = [
        ("zones", b"", "short"),
        ("zones", b"SHUB", "short"),
        ("zones", &[0; 4096], "magic"),
        ("zones", &version, "version"),
        ("zones", &broken, "crc"),
        ("zones", &good[..good.len() - 1], "length"),
        ("zones", &[0x55; 200_000], "long"),
        ("scan", &good, "key"),
    ];
    for (topic, bytes, _) in &wrong {
        (0..50).for_each(|_| put(&session, &format!("{SENSOR_KEY}/{topic}"), bytes));
    }
    // The IDs belong to other hubs, except for an invalid ID and a key with another sensor's name.
    for key in [
        "scanhub/0000000000000001/front/zones",
        "scanhub/5f3a12bc00d1e2f3/rear/zones",
        "scanhub/x/front/zones",
    ] {
        put(&session, key, &good);
    }
    // Ten thousand hub IDs, each with a datagram that matches its key.
    for n in 0..10_000_u64 {
        let topic = Topic::Zones.number();
        let head = Head { hub: n, epoch: 1, topic, revision: 1, ..Head::default() };
        let mut buffer = [0; 100];
        put(&session, &format!("scanhub/{n:016x}/front/zones"), head.seal(&mut buffer, 12).expect("it fits"));
    }
    // Send more than the bridge can handle.
    for _ in 0..20_000 {
        put(&session, &format!("{SENSOR_KEY}/zones"), &broken);
    }
    // The honest sender continues. It sends its announcement again, because its entry was evicted: it had sent samples
    // for less than a second.
    wait_until("samples of an honest sender arrive", || {
        put(&session, &format!("{SENSOR_KEY}/announce"), &sender.announcement(&topics));
        put(&session, &format!("{SENSOR_KEY}/zones"), &zones(&mut sender, Verdict::Stop));
        echo.prints(|line| line["class"] == "zones" && line["verdict"] == "stop")
    });
    let grown = resident_bytes(&here).saturating_sub(before);
    assert!(grown < 64 << 20, "{grown} bytes more");
    let outcome = here.end(INT);
    let overrun = refusal_count(&outcome, "overrun");
    for (_, _, reason) in wrong {
        assert!(refusal_count(&outcome, reason) > 0, "{reason}: {outcome}");
    }
    assert!(refusal_count(&outcome, "key") >= 50 || overrun > 0, "{outcome}");
    let sum: u64 = ["short", "magic", "version", "crc", "length", "long", "key", "capacity", "overrun"]
        .iter()
        .map(|reason| refusal_count(&outcome, reason))
        .sum();
    assert!(sum >= 20_400, "{sum}: {outcome}");
    let published = outcome.of_class("bridge_published");
    assert_eq!(
        published.last().expect("an account")["sensors"].as_array().map(Vec::len),
        Some(1),
        "{outcome}"
    );
    assert_eq!(number(published.last().expect("an account"), "loan_failed"), 0);
}

//! Tests of people on the web page: the page shows the people of `track --as` in the map of the site, each with a
//! number, a trail and the room.

use serde_json::Value;

use crate::browser::{Appearance, Browser};
use crate::testkit::{INT, TestEnv, wait_until};
use crate::track::{SITE_FILE, record_people, replay};
use crate::web::web;
use crate::web_page::{browse, freeze_page};

/// Script that counts the pixels that have the color of people, in a square around the first person.
const GREEN_SCRIPT: &str = "(() => {
    const [x, y] = scanhub.screen(scanhub.people[0].x, scanhub.people[0].y);
    const probe = document.body.appendChild(document.createElement('i'));
    probe.style.color = 'var(--person)';
    const wanted = getComputedStyle(probe).color.match(/\\d+/g).map(Number);
    probe.remove();
    const { data } = document.querySelector('#map').getContext('2d').getImageData(x - 40, y - 40, 80, 80);
    let count = 0;
    for (let i = 0; i < data.length; i += 4) count += wanted.every((one, n) => Math.abs(one - data[i + n]) < 30);
    return count;
})()";

fn number(page: &mut Browser, script: &str) -> f64 {
    page.ask(script).as_f64().unwrap_or_else(|| panic!("{script} is not a number"))
}

#[test]
fn people_are_drawn_at_their_tracked_positions() {
    let env = TestEnv::new();
    let Some(mut page) = browse(&env, Appearance::LAPTOP) else { return };
    let site = env.file("site.toml", SITE_FILE);
    let hub = replay(&env, &record_people(&env, 60));
    let mut track = env.start(&["track", "--site", &site, "--as=house", "--delay=2s", "--json"]);
    wait_until("the tracker publishes and follows the sensors", || {
        let listed = env.run(&["list", "--json"]).of_class("topic");
        let is_subscribed = |line: &&Value| line["topic"] == "foreground" && line["subscribers"] == 1;
        listed.iter().any(|line| line["sensor"] == "house")
            && listed.iter().filter(is_subscribed).count() == 2
    });
    let (_server, host) = web(&env, &[]);
    page.open(&format!("http://{host}/"));
    wait_until("the page follows the tracker", || env.subscribers("house/tracks") > 0);
    env.run(&["control", "hall", "resume"]);

    page.await_true(
        "scanhub.tracks === 1 && document.querySelector('#people').innerText.startsWith('1 person: hall 1')",
    );
    page.await_true("document.querySelector('#people').innerText.startsWith('1 person: kitchen 1')");
    // If the number of a person is larger than the number of people, the page explains it.
    page.await_true(
        "scanhub.tracks === 1 && document.querySelector('#people').textContent === \
         '1 person: kitchen 1' + (scanhub.people[0].id > 1 ? `  ·  tracks so far: ${scanhub.people[0].id}` : '')",
    );
    // The position of the robot in the map is unknown, so the page does not show the verdict of its zones.
    page.await_true("document.querySelector('#verdict').hidden && document.title === 'scanhub'");
    page.await_true("scanhub.tracks === 1 && scanhub.people[0].tail.length > 10");
    // A held picture does not change while the person walks on.
    freeze_page(
        &mut page,
        "scanhub.people[0]?.state === 'confirmed' && scanhub.points('kitchen').length > 100",
    );
    assert!(number(&mut page, GREEN_SCRIPT) > 40.0, "a circle, a tail and a number are drawn");
    let place = ["x", "y"].map(|axis| number(&mut page, &format!("scanhub.people[0].{axis}")));
    let reach = ["x", "y"].map(|axis| number(&mut page, &format!("scanhub.people[0].reach.{axis}")));
    assert!(reach.iter().all(|half| (0.005..0.5).contains(half)), "{reach:?}");
    // The page draws the sensors at the poses of the site, and does not draw the robot's zones.
    assert_eq!(page.ask("scanhub.zones"), 0);
    let far = "scanhub.points('kitchen').filter((at, i) => i % 2 === 0 && (at < -0.2 || at > 12.2)).length";
    assert!(number(&mut page, "scanhub.points('kitchen').length") > 100.0);
    assert_eq!(page.ask(far), 0);

    let id = page.ask("scanhub.people[0].id");
    let is_at_drawn_position = |line: &Value| {
        let one = &line["tracks"][0];
        let near = |key: &str, at: f64| one[key].as_f64().is_some_and(|value| (value - at).abs() < 1e-3);
        id == one["id"].to_string().as_str() && near("x_m", place[0]) && near("y_m", place[1])
    };
    track.await_line("where the page draws the person", is_at_drawn_position);
    assert_eq!(track.end(INT).exit_code, Some(0));
    // After `track` has exited, the page removes the people.
    page.press(" ");
    page.await_true("scanhub.tracks === 0 && document.querySelector('#people').innerText === ''");
    assert_eq!(hub.end(INT).exit_code, Some(0));
    assert!(page.console_errors.is_empty(), "{:?}", page.console_errors);
}

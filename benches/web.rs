//! CPU time of the live picture in a browser, delay until the picture shows a scan, and number of bytes that the server
//! sends. The bench uses `scanhub web` and a headless Chromium, and also viewers that draw nothing. The baseline is a
//! page that draws the same number of points from memory as soon as the browser permits. The bench does not measure the
//! additional delay of a screen and a graphics card.

#[path = "../tests/it/browser.rs"]
#[allow(dead_code, reason = "the tests press keys and make pictures, too")]
mod browser;
mod support;
#[path = "../tests/testkit/child.rs"]
mod test_child;

/// The part of the testkit that the driver of the browser needs.
mod testkit {
    pub(crate) use crate::support::environment::STEP_TIMEOUT as WAIT_TIMEOUT;
    pub(crate) use crate::test_child::{Child, spawn};
}

use std::collections::HashMap;
use std::net::TcpStream;
use std::process::{Command, ExitCode, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use browser::{Appearance, Browser};
use scanhub_schema::Scan;
use serde_json::{Value, json};
use support::environment::{BenchEnvironment, Child, PROGRAM, SENSORS, STEP_TIMEOUT};
use support::figures::{self, Figure, Target, percentile};
use support::usage::ThreadUsage;
use support::{Options, Outcome, clock, subscriber};
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

fn main() -> ExitCode {
    support::main(measure)
}

/// Figures of all runs, in the order of their first values.
#[derive(Default)]
struct FigureList(Vec<Figure>);

impl FigureList {
    /// Adds the value of a run, and the value of its baseline if it has one.
    fn push(
        &mut self,
        (name, unit, target): (&'static str, &'static str, Target),
        value: Option<f64>,
        baseline: Option<f64>,
    ) {
        let at = self.0.iter().position(|figure| figure.name == name).unwrap_or_else(|| {
            self.0.push(Figure { name, unit, hub: Vec::new(), baseline: Vec::new(), target });
            self.0.len() - 1
        });
        self.0[at].hub.extend(value);
        self.0[at].baseline.extend(baseline);
    }
}

fn measure(options: &Options) -> Outcome<()> {
    let span = Duration::from_secs(options.seconds(20));
    let mut series = FigureList::default();
    for _ in 0..options.pairs_or(2) {
        measure_lms(&mut series, span)?;
        measure_rotating(&mut series, span)?;
    }
    figures::print("web", options.json, &series.0);
    Ok(())
}

/// Measures the picture of two sensors with 361 beams at 37.5 Hz.
fn measure_lms(series: &mut FigureList, span: Duration) -> Outcome<()> {
    let environment = BenchEnvironment::new()?;
    let _simulator = environment.simulate_as(&SENSORS, &["--baud", "500000", "--world", "demo"])?;
    let hub = environment.start_hub(&SENSORS)?;
    hub.wait_for_line("ready", STEP_TIMEOUT)?;
    let (web, url) = serve(&environment)?;
    let mut page = Browser::start(environment.file("browser"), Appearance::LAPTOP).ok_or(NO_BROWSER)?;
    page.open("about:blank");
    page.ask(BLANK_SCRIPT);
    thread::sleep(span);
    let blank = numbers(&page.ask("blank"));
    page.open(&url);
    page.await_true("window.scanhub?.beams > 600");
    let size = page.ask("fetch('/').then((page) => page.text()).then((text) => text.length)").as_f64();
    series.push(("bytes of the page", "kB", Target::Max(60.0)), size.map(|bytes| bytes / 1e3), None);
    let delays = delays(&environment, &mut page, span)?;
    for (name, part) in [("published to end of frame, median", 0.5), ("published to end of frame, p99", 0.99)]
    {
        let (delay, baseline) = (percentile(&delays, part), percentile(&blank, part));
        series.push((name, "ms", Target::None), delay, baseline);
        let above = delay.zip(baseline).map(|(delay, baseline)| delay - baseline);
        let name = if part == 0.5 {
            "the same above the baseline, median"
        } else {
            "the same above the baseline, p99"
        };
        series.push((name, "ms", Target::Max(21.7)), above, None);
    }
    drop(page);

    // Names of the figures with zero, one and sixteen viewers: CPU time of the server and of the hub, and ages of
    // scans.
    let names = [
        [
            ("no viewer: server", Target::None),
            ("no viewer: hub", Target::None),
            ("no viewer: age of a scan at a subscriber, median", Target::None),
        ],
        [
            ("1 viewer: server", Target::Max(1.0)),
            ("1 viewer: hub", Target::None),
            ("1 viewer: age of a scan at a subscriber, median", Target::None),
        ],
        [
            ("16 viewers: server", Target::Max(6.0)),
            ("16 viewers: hub", Target::None),
            ("16 viewers: age of a scan at a subscriber, median", Target::None),
        ],
    ];
    for (count, names) in [0, 1, 16].into_iter().zip(names) {
        let viewers = start_viewers(&url, count, span + 2 * SETTLE_TIME);
        thread::sleep(SETTLE_TIME);
        let before =
            [ThreadUsage::of(web.guard.pid(), |_| true)?, ThreadUsage::of(hub.guard.pid(), |_| true)?];
        let started = clock::now();
        let ages = ages(&environment, span)?;
        let elapsed = (clock::now() - started) as f64;
        for ((child, before), (name, target)) in [&web, &hub].into_iter().zip(before).zip(names) {
            let work = ThreadUsage::of(child.guard.pid(), |_| true)?.since(before);
            series.push((name, "%", target), Some(100.0 * work.busy_ns as f64 / elapsed), None);
        }
        series.push((names[2].0, "us", names[2].1), percentile(&ages, 0.5), None);
        viewers.into_iter().for_each(|viewer| drop(viewer.join()));
    }
    let wire = run_viewer(&url, span / 2)?;
    let json = echoed(&environment, span / 2)?;
    series.push(
        ("a second of the default view; as lines of echo --json", "kB", Target::None),
        Some(wire / 1e3),
        Some(json / 1e3),
    );
    drop((web, hub));
    Ok(())
}

/// Measures the picture of two sensors with 3240 beams at 10 Hz. The picture rotates, so that the page has to draw all
/// of it in each frame.
fn measure_rotating(series: &mut FigureList, span: Duration) -> Outcome<()> {
    let environment = BenchEnvironment::new()?;
    let world = environment.file("world").display().to_string();
    std::fs::write(&world, HALL_WORLD)?;
    let flags = ["--family", "rplidar", "--model", "s2", "--world", &world];
    let _simulator = environment.simulate_as(&SENSORS, &flags)?;
    let mut command: Command = environment.hub_command(PROGRAM, &SENSORS);
    for sensor in SENSORS {
        for setting in ["family=rplidar", "model=s2", "beams=3240"] {
            command.arg(format!("--set=link.{sensor}.{setting}"));
        }
    }
    let hub = Child::spawn(command, Stdio::null())?;
    hub.wait_for_line("ready", STEP_TIMEOUT)?;
    let (web, url) = serve(&environment)?;
    let mut page = Browser::start(environment.file("browser"), Appearance::LAPTOP).ok_or(NO_BROWSER)?;
    page.open(&url);
    page.await_true("window.scanhub?.beams > 6000 && scanhub.sensors.every(({ hz }) => hz > 9)");
    page.call("Performance.enable", json!({}));
    page.ask(TURN_SCRIPT);
    thread::sleep(SETTLE_TIME);
    let (frames, script, started) =
        (page.ask("scanhub.frames").as_f64(), script_seconds(&mut page), clock::now());
    thread::sleep(span);
    let (frames, script) = (
        page.ask("scanhub.frames")
            .as_f64()
            .zip(frames)
            .map(|(after, before)| after - before)
            .ok_or("no frames")?,
        script_seconds(&mut page) - script,
    );
    let elapsed = (clock::now() - started) as f64 / 1e9;
    series.push(("2 x 3240 beams at 10 Hz: frames", "1/s", Target::Min(30.0)), Some(frames / elapsed), None);
    let name = "2 x 3240 beams at 10 Hz: script in a frame";
    series.push((name, "ms", Target::Max(4.0)), Some(1e3 * script / frames), None);
    drop((web, hub));
    Ok(())
}

/// Starts the server, and returns the server and the address of its page.
fn serve(environment: &BenchEnvironment) -> Outcome<(Child, String)> {
    let words = ["web", "--listen", "127.0.0.1:0", "--domain", environment.domain.name()];
    let web = Child::start(PROGRAM, &words.map(str::to_owned))?;
    let ready = web.wait_for_line("ready", STEP_TIMEOUT)?;
    let url = ready.words().get(1).ok_or("no address")?.to_string();
    Ok((web, url))
}

/// Returns the times from the receipt of a scan by a subscriber until the end of the frame that draws the scan, in
/// milliseconds, sorted.
fn delays(environment: &BenchEnvironment, page: &mut Browser, span: Duration) -> Outcome<Vec<f64>> {
    let over = AtomicBool::new(false);
    let (received, shown) = thread::scope(|scope| {
        let receivers = SENSORS.map(|sensor| scope.spawn(|| receive(environment, sensor, &over)));
        let mut shown: HashMap<i64, f64> = HashMap::new();
        for _ in 0..=span.as_secs() / 2 {
            thread::sleep(Duration::from_secs(2));
            let pairs = page.ask("scanhub.shown()");
            for pair in pairs.as_array().into_iter().flatten().map(numbers) {
                if let [stamp, shown_ms] = pair[..] {
                    shown.insert(key(stamp), shown_ms);
                }
            }
        }
        over.store(true, Ordering::Relaxed);
        let mut received = HashMap::new();
        for receiver in receivers {
            received.extend(receiver.join().map_err(|_| "a subscriber panicked")??);
        }
        Outcome::Ok((received, shown))
    })?;
    let delay = |(stamp, shown_ms): (&i64, &f64)| Some(shown_ms - received.get(stamp)?);
    let mut delays: Vec<f64> = shown.iter().filter_map(delay).collect();
    delays.sort_by(f64::total_cmp);
    if delays.len() < 100 { Err(format!("only {} scans were seen", delays.len()).into()) } else { Ok(delays) }
}

type ReceivedStamps = HashMap<i64, f64>;

/// Returns the times at which scans of `sensor` arrived, in milliseconds since 1970, by the stamp of the scan.
fn receive(
    environment: &BenchEnvironment,
    sensor: &str,
    is_finished: &AtomicBool,
) -> Result<ReceivedStamps, String> {
    let follow = || -> Outcome<ReceivedStamps> {
        let mut received = ReceivedStamps::new();
        let mut scans =
            subscriber::builder::<Scan>(environment.domain.name(), sensor).timeout(STEP_TIMEOUT).open()?;
        while !is_finished.load(Ordering::Relaxed) {
            let scan = scans.next()?.ok_or("no scan")?;
            let now_ms = SystemTime::now().duration_since(UNIX_EPOCH)?.as_secs_f64() * 1e3;
            received.insert(key(scan.header().wall_ns as f64 / 1e6), now_ms);
        }
        Ok(received)
    };
    follow().map_err(|error| error.to_string())
}

/// Converts a stamp in milliseconds, as the page has it, to a number of 5 us. Such a number can be compared exactly.
fn key(stamp_ms: f64) -> i64 {
    (stamp_ms * 200.0).round() as i64
}

/// Returns the ages of scans at a subscriber in microseconds, sorted.
fn ages(environment: &BenchEnvironment, span: Duration) -> Outcome<Vec<f64>> {
    let mut scans =
        subscriber::builder::<Scan>(environment.domain.name(), SENSORS[0]).timeout(STEP_TIMEOUT).open()?;
    let (mut ages, until) = (Vec::new(), clock::now() + span.as_nanos() as u64);
    while clock::now() < until {
        let stamp = scans.next()?.ok_or("no scan")?.header().stamp_last_ns;
        ages.push(clock::now().saturating_sub(stamp) as f64 / 1e3);
    }
    ages.sort_by(f64::total_cmp);
    Ok(ages)
}

/// Returns the number of bytes per second that `echo --json` prints for the topics in the default view of the page.
fn echoed(environment: &BenchEnvironment, span: Duration) -> Outcome<f64> {
    let topics = ["*/scan", "*/foreground", "*/background", "*/marks", "*/zones", "*/status"];
    let run_for = format!("--for={}s", span.as_secs().max(1));
    let mut words = vec!["echo", "--json", "--domain", environment.domain.name(), &run_for];
    words.extend(topics);
    let output = Command::new(PROGRAM).args(words).env("SCANHUB_LOG", "off").output()?;
    Ok(output.stdout.len() as f64 / span.as_secs().max(1) as f64)
}

/// Returns the CPU time of the page's scripts in seconds.
fn script_seconds(page: &mut Browser) -> f64 {
    let metrics_reply = page.call("Performance.getMetrics", json!({}));
    let mut metrics = metrics_reply["metrics"].as_array().into_iter().flatten();
    let spent = metrics.find(|metric| metric["name"] == "ScriptDuration");
    spent.and_then(|metric| metric["value"].as_f64()).unwrap_or(f64::NAN)
}

fn numbers(value: &Value) -> Vec<f64> {
    let mut numbers: Vec<f64> = value.as_array().into_iter().flatten().filter_map(Value::as_f64).collect();
    if numbers.len() > 2 {
        numbers.sort_by(f64::total_cmp);
    }
    numbers
}

/// Script of the baseline page, which needs no data. It draws 722 points 37.5 times per second, each time as soon as
/// the browser permits.
const BLANK_SCRIPT: &str = "(() => {
    const canvas = document.createElement('canvas');
    [canvas.width, canvas.height] = [1280, 800];
    document.body.append(canvas);
    const pen = canvas.getContext('2d');
    const xy = Float32Array.from({ length: 1444 }, () => 800 * Math.random());
    window.blank = [];
    let came = null;
    setInterval(() => {
        if (came !== null) return;
        came = performance.now();
        requestAnimationFrame(() => {
            pen.fillStyle = '#fff';
            pen.fillRect(0, 0, 1280, 800);
            pen.fillStyle = '#123';
            for (let i = 0; i < 1444; i += 2) pen.fillRect(xy[i], xy[i + 1], 3.5, 3.5);
            blank.push(performance.now() - came);
            came = null;
        });
    }, 26.7);
})()";
/// Script that rotates the picture with each frame.
const TURN_SCRIPT: &str = "(() => {
    const turn = () => {
        dispatchEvent(new KeyboardEvent('keydown', { key: '[' }));
        requestAnimationFrame(turn);
    };
    turn();
})()";
/// World with walls on all sides, so that every beam has a range.
const HALL_WORLD: &str =
    "[[thing]]\nline = [[6000, -6000], [6000, 6000], [-6000, 6000], [-6000, -6000], [6000, -6000]]\n";
const NO_BROWSER: &str = "there is no browser (Debian: apt-get install chromium)";
/// Time after which rates and caches no longer change.
const SETTLE_TIME: Duration = Duration::from_secs(2);

/// Runs a viewer without a picture. It subscribes to the same channels as the page, and reads as fast as possible for
/// `span`. Returns the number of bytes per second in the messages that arrive after the first second.
fn run_viewer(url: &str, span: Duration) -> Outcome<f64> {
    let mut socket = connect(url)?;
    let (started, mut bytes, mut since) = (Instant::now(), 0, None);
    while started.elapsed() < span {
        match socket.read()? {
            Message::Text(text) => {
                let message: Value = serde_json::from_str(&text)?;
                let channels = message["channels"].as_array().into_iter().flatten();
                let word = |channel: &Value| channel["topic"].as_str()?.rsplit('/').next().map(str::to_owned);
                let is_seldom =
                    |word: String| ["lines", "cloud", "tilt", "tf_static"].contains(&word.as_str());
                let expected = channels.filter(|channel| !word(channel).is_some_and(is_seldom));
                let expected: Vec<Value> = expected
                    .map(|channel| json!({ "id": channel["id"], "channelId": channel["id"] }))
                    .collect();
                if !expected.is_empty() {
                    let request = json!({ "op": "subscribe", "subscriptions": expected });
                    socket.send(Message::text(request.to_string()))?;
                }
            }
            Message::Binary(frame) if started.elapsed() > WARM_UP_TIME => {
                since.get_or_insert_with(Instant::now);
                bytes += frame.len();
            }
            _ => {}
        }
    }
    Ok(bytes as f64 / since.ok_or("no message arrived")?.elapsed().as_secs_f64())
}

/// Starts `count` viewers, each in its own thread, which run until `span` has elapsed.
fn start_viewers(url: &str, count: usize, span: Duration) -> Vec<thread::JoinHandle<()>> {
    let one = |_| {
        let url = url.to_owned();
        thread::spawn(move || {
            if let Err(error) = run_viewer(&url, span) {
                eprintln!("viewer: {error}");
            }
        })
    };
    (0..count).map(one).collect()
}

fn connect(url: &str) -> Outcome<WebSocket<TcpStream>> {
    let host = url.trim_start_matches("http://").trim_end_matches('/');
    let mut request = format!("ws://{host}/").into_client_request()?;
    request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse()?);
    let (socket, _) = tungstenite::client(request, TcpStream::connect(host)?)?;
    Ok(socket)
}

/// Time at the start of a viewer's run whose messages do not count.
const WARM_UP_TIME: Duration = Duration::from_secs(1);

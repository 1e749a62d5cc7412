//! Model checks of the doorbell over all interleavings of hubs and subscribers, and all permitted orders of their
//! memory accesses. The futex is modeled by a lock and a condition variable. A wake-up is lost if a subscriber sleeps
//! and no hub will wake it any more. The model then ends the sleep and counts a lost wake-up.

use std::sync::Arc;
use std::sync::atomic::AtomicUsize;

use loom::sync::atomic::{AtomicU32, fence};
use loom::sync::{Condvar, Mutex};
use loom::thread;

use super::*;

/// Model of the kernel's futex, which compares words and puts threads to sleep under one lock.
#[derive(Default)]
struct Futex {
    calls: Mutex<Calls>,
    changed: Condvar,
}

/// Number of wake-ups so far, and number of hubs that may still wake threads.
#[derive(Default)]
struct Calls {
    wakes: u32,
    hubs: u32,
}

struct ModelWord {
    value: AtomicU32,
    futex: Arc<Futex>,
}

impl ModelWord {
    fn new(futex: &Arc<Futex>) -> ModelWord {
        ModelWord { value: AtomicU32::new(0), futex: futex.clone() }
    }
}

impl FutexWord for ModelWord {
    fn fetch_add(&self, summand: u32, order: Ordering) -> u32 {
        self.value.fetch_add(summand, order)
    }

    fn load(&self, order: Ordering) -> u32 {
        self.value.load(order)
    }

    fn store(&self, value: u32, order: Ordering) {
        self.value.store(value, order);
    }

    fn fence(order: Ordering) {
        fence(order);
    }

    fn wake(&self) {
        self.futex.calls.lock().unwrap().wakes += 1;
        self.futex.changed.notify_all();
    }
}

/// Sleeps like the system call: returns at once if one of the words differs from its given value. Returns `false` if no
/// hub is left to wake the caller.
fn sleep(words: &[(&ModelWord, u32)]) -> bool {
    let futex = &words[0].0.futex;
    let mut calls = futex.calls.lock().unwrap();
    if words.iter().any(|(word, seen)| word.load(Ordering::Relaxed) != *seen) {
        return true;
    }
    let wakes = calls.wakes;
    while calls.wakes == wakes {
        if calls.hubs == 0 {
            return false;
        }
        calls = futex.changed.wait(calls).unwrap();
    }
    true
}

/// The page of one sensor, and the number of the last sample. The memory orders of the words decide when a thread sees
/// a new number.
struct Sensor {
    rung: ModelWord,
    closed: ModelWord,
    sent: AtomicU32,
}

impl Sensor {
    fn new(futex: &Arc<Futex>) -> Sensor {
        Sensor { rung: ModelWord::new(futex), closed: ModelWord::new(futex), sent: AtomicU32::new(0) }
    }

    fn send(&self, number: u32) {
        self.sent.store(number, Ordering::Relaxed);
    }

    /// Waits for sample `number` like a subscriber: reads the count, then the samples, then sleeps. Returns `false` if
    /// the wake-up was lost.
    fn await_sample(&self, number: u32) -> bool {
        loop {
            let ring_count = read_count(&self.rung);
            if self.sent.load(Ordering::Relaxed) >= number {
                return true;
            }
            if !sleep(&[(&self.rung, ring_count)]) {
                return false;
            }
        }
    }

    fn await_end(&self) -> bool {
        loop {
            let ring_count = read_count(&self.rung);
            if self.closed.load(Ordering::Relaxed) != 0 {
                return true;
            }
            if !sleep(&[(&self.rung, ring_count)]) {
                return false;
            }
        }
    }
}

fn new_sensor() -> Arc<Sensor> {
    Arc::new(Sensor::new(&Arc::default()))
}

/// Runs `act` on `sensor` in a thread.
fn spawn_subscriber(
    sensor: &Arc<Sensor>,
    act: impl FnOnce(&Sensor) -> bool + 'static,
) -> thread::JoinHandle<bool> {
    let sensor = sensor.clone();
    thread::spawn(move || act(&sensor))
}

/// Runs `act` in a thread that is counted as a hub until `act` returns.
fn spawn_hub(sensor: &Arc<Sensor>, act: impl FnOnce(&Sensor) + 'static) -> thread::JoinHandle<()> {
    let sensor = sensor.clone();
    sensor.rung.futex.calls.lock().unwrap().hubs += 1;
    thread::spawn(move || {
        act(&sensor);
        sensor.rung.futex.calls.lock().unwrap().hubs -= 1;
        sensor.rung.futex.changed.notify_all();
    })
}

/// Runs `act` in all interleavings with at most two switches away from a thread that could continue. Nearly all defects
/// of this kind need no more switches. With this limit, a run takes seconds instead of hours. Returns the number of
/// interleavings in which `act` returns `false`.
fn count_lost_wakeups(act: impl Fn() -> bool + Sync + Send + 'static) -> usize {
    let lost = Arc::new(AtomicUsize::new(0));
    let count = lost.clone();
    let mut model = loom::model::Builder::new();
    model.preemption_bound = Some(2);
    model.check(move || {
        if !act() {
            count.fetch_add(1, Ordering::Relaxed);
        }
    });
    lost.load(Ordering::Relaxed)
}

#[test]
fn no_wake_is_lost_by_subscriber_of_two_samples() {
    let lost = count_lost_wakeups(|| {
        let sensor = new_sensor();
        let hub = spawn_hub(&sensor, |sensor| {
            for number in 1..=2 {
                sensor.send(number);
                ring(&sensor.rung);
            }
        });
        let got = sensor.await_sample(1) && sensor.await_sample(2);
        hub.join().unwrap();
        got
    });
    assert_eq!(lost, 0);
}

#[test]
fn one_call_wakes_two_subscribers() {
    let lost = count_lost_wakeups(|| {
        let sensor = new_sensor();
        let hub = spawn_hub(&sensor, |sensor| {
            sensor.send(1);
            ring(&sensor.rung);
        });
        let other = spawn_subscriber(&sensor, |sensor| sensor.await_sample(1));
        let got = sensor.await_sample(1);
        hub.join().unwrap();
        other.join().unwrap() && got
    });
    assert_eq!(lost, 0);
}

#[test]
fn next_hub_wakes_sleepers_left_by_a_killed_hub() {
    // The hub is killed before it increments the count, or after that.
    for counted in [false, true] {
        let lost = count_lost_wakeups(move || {
            let sensor = new_sensor();
            let hubs = spawn_hub(&sensor, move |sensor| {
                sensor.send(1);
                if counted {
                    sensor.rung.fetch_add(1, Ordering::Release);
                }
                sensor.send(2);
                ring(&sensor.rung);
            });
            let got = sensor.await_sample(2);
            hubs.join().unwrap();
            got
        });
        assert_eq!(lost, 0, "counted: {counted}");
    }
}

#[test]
fn no_subscriber_sleeps_at_a_closed_doorbell() {
    let lost = count_lost_wakeups(|| {
        let sensor = new_sensor();
        let hub = spawn_hub(&sensor, |sensor| {
            ring(&sensor.rung);
            close(&sensor.closed, &sensor.rung);
        });
        let ended = sensor.await_end();
        hub.join().unwrap();
        ended
    });
    assert_eq!(lost, 0);
}

#[test]
fn subscriber_wakes_at_each_of_two_doorbells() {
    let lost = count_lost_wakeups(|| {
        let futex = Arc::default();
        let sensors = [Sensor::new(&futex), Sensor::new(&futex)].map(Arc::new);
        let hubs = sensors.each_ref().map(|sensor| {
            spawn_hub(sensor, |sensor| {
                sensor.send(1);
                ring(&sensor.rung);
            })
        });
        let got = loop {
            let ring_counts = sensors.each_ref().map(|sensor| read_count(&sensor.rung));
            if sensors.iter().all(|sensor| sensor.sent.load(Ordering::Relaxed) == 1) {
                break true;
            }
            if !sleep(&[(&sensors[0].rung, ring_counts[0]), (&sensors[1].rung, ring_counts[1])]) {
                break false;
            }
        };
        hubs.into_iter().for_each(|hub| hub.join().unwrap());
        got
    });
    assert_eq!(lost, 0);
}

#[test]
fn model_detects_a_hub_that_wakes_before_it_counts() {
    let lost = count_lost_wakeups(|| {
        let sensor = new_sensor();
        let hub = spawn_hub(&sensor, |sensor| {
            sensor.send(1);
            sensor.rung.wake();
            sensor.rung.fetch_add(1, Ordering::Release);
        });
        let got = sensor.await_sample(1);
        hub.join().unwrap();
        got
    });
    assert!(lost > 0);
}

#[test]
fn model_detects_a_wakeup_lost_without_the_fence() {
    let lost = count_lost_wakeups(|| {
        let sensor = new_sensor();
        let hub = spawn_hub(&sensor, |sensor| {
            sensor.send(1);
            ring(&sensor.rung);
        });
        let got = loop {
            // This load lacks the fence of `read_count`.
            let ring_count = sensor.rung.load(Ordering::Relaxed);
            if sensor.sent.load(Ordering::Relaxed) == 1 {
                break true;
            }
            if !sleep(&[(&sensor.rung, ring_count)]) {
                break false;
            }
        };
        hub.join().unwrap();
        got
    });
    assert!(lost > 0);
}

#[test]
fn hub_that_reads_the_count_detects_the_subscriber() {
    let lost = count_lost_wakeups(|| {
        let sensor = new_sensor();
        let joiner = spawn_subscriber(&sensor, |sensor| {
            sensor.send(1);
            increment(&sensor.rung);
            true
        });
        let is_counted = read_count(&sensor.rung) == 1;
        let is_there = sensor.sent.load(Ordering::Relaxed) == 1;
        joiner.join().unwrap();
        is_there || !is_counted && read_count(&sensor.rung) == 1
    });
    assert_eq!(lost, 0);
}

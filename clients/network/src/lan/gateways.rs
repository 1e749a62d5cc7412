//! The table of gateways: everything that a receiver keeps about the gateways that send to it, and what it counts.
//!
//! Each start of a gateway is a run with its own epoch. The run with the highest epoch is active, and lower ones are
//! retired. Memory is bounded by the number of runs and of their sensors and topics, no matter who sends. If there is
//! no room for another run, the run that retired first is evicted. If no run is retired, active runs are compared by
//! their [`EvictionRank`].
//!
//! Anyone who can send can invent gateways. A run that delivers samples is therefore never evicted for a run that only
//! announces itself. Among the active runs that may be evicted, the one that has been silent for longest is evicted
//! first. Time is an argument, and MACs are checked in `incoming`.

use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap};

use scanhub_schema::Topic;
use scanhub_schema::datagram::{Announce, Datagram, DatagramError, Head};

use super::senders::{DuplicateDetector, SILENCE_NS, SenderMatch, Senders};
use super::sequence::{SequenceStatus, StreamCounters};

/// Maximum number of runs of gateways that are distinguished.
pub const MAX_RUNS: usize = 64;
/// Maximum number of sensors and topics, of all runs together, that are counted separately.
pub const MAX_ROWS: usize = 1024;
/// Maximum number of gateways with a key whose epochs are kept. If the epoch of a gateway is forgotten, its recorded
/// datagrams are still refused, because of their old stamps.
pub(crate) const MAX_EPOCHS: usize = 1024;

/// Gateways that a receiver distinguishes: their runs, sensors, senders, clocks and counters.
///
/// The counters of a topic start with its first datagram, or with an announcement that arrives before that datagram.
/// Samples that were sent before the start do not count as lost. An announcement that arrives after the first datagram
/// therefore does not change the start. A late datagram from before the start moves the start back.
///
/// The counters of an evicted run, and of a gateway that is forgotten with its last run, are added to
/// [`evicted`](GatewayTable::evicted). Rows and evicted totals together therefore always count everything that was
/// accepted.
///
/// Two gateways with the same number and epoch are distinguished by their senders and announcements, and only the first
/// gateway is accepted. After it has been silent for 3 s, another sender is accepted as a new run, unless two gateways
/// are known to send.
pub struct GatewayTable {
    /// Bit n is set if the receiver has joined the group of topic number n.
    joined_topics: u64,
    /// Whether the receiver has a key, so that only samples of announced topics are accepted.
    is_keyed: bool,
    /// Gateways by number.
    gateways: BTreeMap<u64, Gateway>,
    run_count: usize,
    row_count: usize,
    epoch_count: usize,
    is_epoch_new: bool,
    /// Number of the last event whose order is recorded, such as the retirement of a run.
    next_order: u64,
    /// Number of gateways whose clocks were reported to differ.
    reported_clocks: usize,
    evicted: EvictedTotals,
    refused: [u64; DatagramError::ALL.len()],
}

/// State of one gateway.
#[derive(Default)]
struct Gateway {
    /// Runs by epoch. The last one is active.
    runs: BTreeMap<u32, Run>,
    stored_epoch: Option<StoredEpoch>,
    duplicates: DuplicateDetector,
    /// Whether it was reported that its clock differs. Such a gateway is never forgotten, so that the report is not
    /// repeated. There are at most [`MAX_RUNS`] of them.
    is_clock_reported: bool,
    /// Samples that did not fit into the memory that remote sensors may use.
    no_room: u64,
}

/// Highest epoch of a gateway in datagrams that were authenticated with the key. It outlives the runs and, in a file,
/// the receiver.
struct StoredEpoch {
    epoch: u32,
    order: u64,
}

/// State of one run of a gateway.
struct Run {
    /// Time at which the run was accepted.
    since_ns: u64,
    /// Position of the run in the order in which runs were accepted.
    accepted: u64,
    /// Position of the run in the order in which runs retired; `None` for the active run of a gateway.
    retired: Option<u64>,
    rank: EvictionRank,
    senders: Senders,
    delays: Delays,
    /// Sensors by their number in the hub.
    sensors: BTreeMap<u8, Sensor>,
}

/// State of one sensor in one run of its gateway.
#[derive(Default)]
struct Sensor {
    announced: Option<Announce>,
    /// Whether the sensor's number was announced with another name before, because the hub restarted with its sensors
    /// in another order.
    is_renamed: bool,
    /// Whether the sensor was printed under its number, because its name was unknown.
    is_numbered: bool,
    /// Counters by the topic's number.
    rows: BTreeMap<u8, StreamCounters>,
}

/// Gateway and epoch of a run.
type RunId = (u64, u32);

/// Totals of the runs that were evicted, and of the gateways that were forgotten with them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EvictedTotals {
    /// Runs of gateways that were removed.
    pub runs: u64,
    /// Runs that were evicted while they were still active.
    pub evicted_active: u64,
    /// Distinct sequence numbers that arrived.
    pub received: u64,
    /// Sequence numbers that did not arrive, and cannot arrive any more because their run has ended.
    pub lost: u64,
    /// Sequence numbers that arrived again.
    pub duplicate: u64,
    /// Sequence numbers among `received` that arrived after a higher one.
    pub reordered: u64,
    /// Samples of forgotten gateways that did not fit into the memory that remote sensors may use.
    pub no_room: u64,
}

/// Result of accepting a datagram.
pub(super) struct AcceptedDatagram {
    pub(super) status: SequenceStatus,
    /// Whether a run of the gateway begins with this datagram.
    pub(super) begins: bool,
    /// Number of samples of the topic that were sent between the previous sample and this one, and have not arrived.
    pub(super) missed: u32,
    /// Number of bytes of memory that the payload fills when it is unpacked.
    pub(super) room: usize,
    /// Content of an announcement; `None` for a sample.
    pub(super) announce: Option<Announce>,
}

impl GatewayTable {
    /// Creates a table for a receiver that has joined the groups of `topics`. Announcements of other topics are
    /// ignored, because their samples would count as lost.
    pub fn new(topics: &[Topic]) -> GatewayTable {
        GatewayTable {
            joined_topics: topics.iter().fold(0, |bits, topic| bits | 1 << topic.number()),
            is_keyed: false,
            gateways: BTreeMap::new(),
            run_count: 0,
            row_count: 0,
            epoch_count: 0,
            is_epoch_new: false,
            next_order: 0,
            reported_clocks: 0,
            evicted: EvictedTotals::default(),
            refused: [0; DatagramError::ALL.len()],
        }
    }

    /// Converts the table for a receiver with a key. Samples are then accepted only from announced sensors and topics,
    /// starting with the number in the first announcement. `epochs` has the highest known epoch of each gateway, and
    /// earlier runs are refused. No other sender is accepted as the next run of a silent gateway. Recorded datagrams
    /// therefore cannot be replayed.
    pub(super) fn with_key(mut self, epochs: HashMap<u64, u32>) -> GatewayTable {
        self.is_keyed = true;
        let mut epochs: Vec<_> = epochs.into_iter().collect();
        epochs.sort_unstable_by_key(|&(hub, epoch)| Reverse((epoch, hub)));
        epochs.truncate(MAX_EPOCHS);
        epochs.iter().rev().for_each(|&(hub, epoch)| self.store_epoch(hub, epoch));
        self.is_epoch_new = false;
        self
    }

    /// Checks and counts `bytes`, a datagram with a whole sample, for a receiver without a key. `from` identifies the
    /// sender, for example its address and port. `now_ns` is the time of any clock that is never set. The payload of an
    /// accepted datagram can be unpacked.
    ///
    /// # Errors
    ///
    /// Returns the reason why the datagram is refused. The reason is counted, and nothing else changes.
    pub fn receive<'a>(
        &mut self,
        bytes: &'a [u8],
        from: u64,
        now_ns: u64,
    ) -> Result<(Datagram<'a>, SequenceStatus), DatagramError> {
        let read = Datagram::read(bytes);
        let taken =
            read.and_then(|datagram| Ok((datagram, self.take(&datagram, from, false, now_ns)?.status)));
        taken.inspect_err(|reason| self.refuse(*reason))
    }

    /// Counts a datagram that is refused for this reason.
    pub(super) fn refuse(&mut self, reason: DatagramError) {
        self.refused[reason as usize] += 1;
    }

    /// Returns how many datagrams were refused for this reason.
    pub fn refused(&self, reason: DatagramError) -> u64 {
        self.refused[reason as usize]
    }

    /// Returns the totals of everything that was evicted.
    pub fn evicted(&self) -> EvictedTotals {
        self.evicted
    }

    /// Returns the counters of every sensor and topic that has sent samples, by gateway, epoch, sensor and topic.
    pub fn rows(&self) -> impl Iterator<Item = &StreamCounters> {
        let runs = self.gateways.values().flat_map(|gateway| gateway.runs.values());
        runs.flat_map(Run::rows).filter(|row| row.received + row.lost() > 0)
    }

    /// Checks a complete sample, and records it if it is accepted. A sample that was reassembled from parts has the
    /// header of one of them.
    ///
    /// With `may_move`, the sender of an announcement may be the new address of its gateway, although the announcement
    /// also names another run of the hub. The previous address must then be silent, and the announcement's number must
    /// be higher than all earlier ones of its sensor. Set `may_move` only for announcements that are authenticated and
    /// were sent just now.
    ///
    /// # Errors
    ///
    /// Returns the reason why the datagram is refused. The reason is not counted yet.
    pub(super) fn take(
        &mut self,
        datagram: &Datagram<'_>,
        from: u64,
        may_move: bool,
        now_ns: u64,
    ) -> Result<AcceptedDatagram, DatagramError> {
        let (head, run_id) = (&datagram.head, (datagram.head.hub, datagram.head.epoch));
        // The payload is checked only by `announce` and `check_payload`. Everything that follows uses their results.
        let announce = datagram.announce();
        let boot = announce.map(|announce| announce.boot);
        let known = self.find(run_id)?;
        let room = if announce.is_some() { Ok(0) } else { datagram.check_payload() };
        let mut sender = known.map_or(SenderMatch::Own, |run| run.senders.match_sender(from, boot, now_ns));
        let is_ahead = || known.and_then(|run| run.row(head)).is_some_and(|row| row.is_ahead(head.sequence));
        let moved_to = boot.filter(|_| sender == SenderMatch::Next && may_move && is_ahead());
        let is_known = known.is_some();
        let is_twin = sender == SenderMatch::Twin || sender == SenderMatch::Next && self.is_keyed;
        if let Some(run) = self.run_mut(run_id) {
            if let Some(boot) = moved_to {
                run.senders.move_to(from, boot, now_ns);
                sender = SenderMatch::Own;
            } else if is_twin {
                if room.is_ok() {
                    run.senders.record(from, boot, now_ns);
                }
                return Err(DatagramError::Twin);
            }
        }
        let is_known = is_known && sender == SenderMatch::Own;
        let arrival = Arrival { is_sample: head.topic != Announce::NUMBER, now_ns };
        match self.run(run_id).and_then(|run| run.row(head)) {
            // The run of the silent gateway is removed below, which makes room.
            _ if sender == SenderMatch::Next => {}
            Some(row) if row.is_stale(head.sequence) => return Err(DatagramError::Stale),
            Some(row) if self.is_keyed && row.is_before(head.sequence) => return Err(DatagramError::Stale),
            None if self.is_keyed && arrival.is_sample => return Err(DatagramError::Untimely),
            None if !self.has_room(run_id, is_known, arrival) => return Err(DatagramError::Capacity),
            _ => {}
        }
        let room = room?;
        if sender == SenderMatch::Next {
            self.end(run_id, false);
        }
        if !is_known {
            self.begin(run_id, arrival);
        }
        if self.is_keyed {
            self.store_epoch(head.hub, head.epoch);
        }
        if let Some(run) = self.run_mut(run_id) {
            run.rank.take(arrival);
            run.senders.record(from, boot, now_ns);
        }
        let row = self.row(head, head.topic, head.sequence, arrival);
        let (missed, status) = row.map_or((0, SequenceStatus::New), |row| {
            (row.missed_before(head.sequence), row.record(head.sequence))
        });
        if let Some(gateway) =
            self.gateways.get_mut(&head.hub).filter(|_| status != SequenceStatus::Duplicate)
        {
            gateway.duplicates.on_accepted();
        }
        if let Some(announce) = &announce {
            self.announce_numbers(head, announce, arrival);
        }
        Ok(AcceptedDatagram { status, begins: !is_known, missed, room, announce })
    }

    /// Records the next sequence numbers of an announcement. A topic for which the table has no free row gets a row
    /// with its first datagram, if a row is free by then.
    fn announce_numbers(&mut self, head: &Head, announce: &Announce, arrival: Arrival) {
        let followed = self.joined_topics;
        let is_followed = |number: u8| number < 64 && followed >> number & 1 == 1;
        for announced in announce.topics().iter().filter(|announced| is_followed(announced.topic)) {
            if let Some(row) = self.row(head, announced.topic, announced.next, arrival) {
                row.announce(announced.next);
            }
        }
    }

    /// Checks a part of a sample before memory is used for the part. The sample is checked and counted when it is
    /// complete. Returns whether the sample is a duplicate. Without a key, every part is accepted.
    ///
    /// # Errors
    ///
    /// Returns [`DatagramError::Epoch`], [`DatagramError::Stale`] or [`DatagramError::Untimely`] if the whole sample
    /// would be refused for this reason.
    pub(super) fn check_part(&self, head: &Head) -> Result<bool, DatagramError> {
        if !self.is_keyed {
            return Ok(false);
        }
        let run = self.find((head.hub, head.epoch))?;
        let row = run.and_then(|run| run.row(head)).ok_or(DatagramError::Untimely)?;
        if row.is_stale(head.sequence) || row.is_before(head.sequence) {
            return Err(DatagramError::Stale);
        }
        Ok(row.has_arrived(head.sequence))
    }

    /// Returns whether the sensor that sent `head` was announced in this run of its gateway, and the run has not been
    /// evicted since.
    pub(super) fn is_announced(&self, head: &Head) -> bool {
        let sensor = self.sensor(head.hub, head.epoch, head.sensor);
        sensor.is_some_and(|sensor| sensor.rows.contains_key(&Announce::NUMBER))
    }

    /// Returns the time at which the first datagram of this run of `hub` was accepted, unless the run has been evicted.
    /// If this time changes, another gateway has begun a run with the same epoch, or the run was evicted in between.
    pub fn since_ns(&self, hub: u64, epoch: u32) -> Option<u64> {
        Some(self.run((hub, epoch))?.since_ns)
    }

    /// Returns whether this run of `hub` is active and known to deliver: a second or more lies between its first and
    /// its last accepted sample.
    pub fn is_proven(&self, hub: u64, epoch: u32) -> bool {
        self.find((hub, epoch)).is_ok_and(|run| run.is_some_and(|run| run.rank.is_proven()))
    }

    /// Returns whether two gateways are known to send under this number and epoch. All datagrams of one of them are
    /// refused as [`DatagramError::Twin`].
    fn is_shared(&self, hub: u64, epoch: u32) -> bool {
        self.find((hub, epoch)).is_ok_and(|run| run.is_some_and(|run| run.senders.is_shared()))
    }

    /// Records that a datagram with `head` was refused because of its epoch or sender. Returns whether two gateways are
    /// known to send under its number.
    pub(super) fn is_duplicate(&mut self, head: &Head, now_ns: u64) -> bool {
        let is_shared = self.is_shared(head.hub, head.epoch);
        let gateway = self.gateways.get_mut(&head.hub);
        is_shared || gateway.is_some_and(|gateway| gateway.duplicates.on_refused(now_ns))
    }

    /// Records an announcement that was accepted and is newer than all others of its sensor. First, returns by how many
    /// ns this machine's clock is ahead of the gateway's, if the clocks differ and that was not reported yet. Second,
    /// returns whether the sensor was printed under its number before.
    pub(super) fn announce(&mut self, head: &Head, announce: &Announce, wall_ns: u64) -> (Option<i64>, bool) {
        let Some(gateway) = self.gateways.get_mut(&head.hub) else { return (None, false) };
        let Some(run) = gateway.runs.get_mut(&head.epoch) else { return (None, false) };
        let sensor = run.sensors.entry(head.sensor).or_default();
        let before = sensor.announced.replace(*announce);
        sensor.is_renamed |= before.is_some_and(|before| before.sensor() != announce.sensor());
        let is_named = std::mem::take(&mut sensor.is_numbered);
        run.delays.add(wall_ns.wrapping_sub(head.stamp_ns) as i64);
        let ahead_ns = run.delays.difference_ns().filter(|_| !run.delays.clocks_agree());
        // The number of reports is limited, because anyone who can send can invent gateways.
        let is_new = !gateway.is_clock_reported && self.reported_clocks < MAX_RUNS;
        if ahead_ns.is_some() && is_new {
            gateway.is_clock_reported = true;
            self.reported_clocks += 1;
        }
        (ahead_ns.filter(|_| is_new), is_named)
    }

    /// Returns the age of a sample that arrived at `wall_ns`, in ns. `None` if the difference of the clocks is unknown
    /// or too large.
    pub(super) fn age_ns(&self, head: &Head, wall_ns: u64) -> Option<u64> {
        self.run((head.hub, head.epoch)).filter(|run| run.delays.clocks_agree())?;
        wall_ns.checked_sub(head.stamp_ns)
    }

    /// Returns the last announcement of a sensor.
    pub fn announced(&self, hub: u64, epoch: u32, sensor: u8) -> Option<&Announce> {
        self.sensor(hub, epoch, sensor)?.announced.as_ref()
    }

    /// Returns the sensor's name, or `#` and its number while it is not announced.
    pub fn name(&self, hub: u64, epoch: u32, sensor: u8) -> String {
        let announced = self.announced(hub, epoch, sensor);
        announced.map_or_else(|| format!("#{sensor}"), |announced| announced.sensor().to_owned())
    }

    /// Returns the name of the sensor that sent `head`, as [`name`](Self::name) does, for printing. If that is only a
    /// number, records it, so that the name is reported later.
    pub(super) fn printed_name(&mut self, head: &Head) -> String {
        if let Some(run) = self.run_mut((head.hub, head.epoch)) {
            let sensor = run.sensors.entry(head.sensor).or_default();
            sensor.is_numbered |= sensor.announced.is_none();
        }
        self.name(head.hub, head.epoch, head.sensor)
    }

    /// Returns the name of a row's sensor, as [`name`](Self::name) does. If the sensor's number had several names,
    /// returns `#` and the number, because the row counts the samples under all of these names.
    pub(crate) fn row_name(&self, row: &StreamCounters) -> String {
        match self.sensor(row.hub, row.epoch, row.sensor) {
            Some(sensor) if sensor.is_renamed => format!("#{}", row.sensor),
            _ => self.name(row.hub, row.epoch, row.sensor),
        }
    }

    /// Returns how many samples of the row's topic were replaced by newer ones before they were sent, as the gateway
    /// announced last. `None` if the gateway does not announce that.
    pub fn replaced(&self, row: &StreamCounters) -> Option<u32> {
        self.announced(row.hub, row.epoch, row.sensor)?.replaced(row.topic)
    }

    /// Counts a sample of `hub` that did not fit into the memory that remote sensors may use.
    pub(super) fn count_no_room(&mut self, hub: u64) {
        if let Some(gateway) = self.gateways.get_mut(&hub) {
            gateway.no_room += 1;
        }
    }

    /// Returns the gateways with samples that did not fit into the memory that remote sensors may use, and the number
    /// of these samples. Samples of forgotten gateways are counted in [`EvictedTotals::no_room`].
    pub fn no_room(&self) -> impl Iterator<Item = (u64, u64)> {
        let all = self.gateways.iter().map(|(hub, gateway)| (*hub, gateway.no_room));
        all.filter(|(_, no_room)| *no_room > 0)
    }

    /// Returns the highest authenticated epoch of `hub`, if it is kept.
    pub(super) fn stored_epoch(&self, hub: u64) -> Option<u32> {
        Some(self.gateways.get(&hub)?.stored_epoch.as_ref()?.epoch)
    }

    /// Returns the highest authenticated epochs of all gateways if one of them is new since the last call.
    pub(super) fn take_epochs(&mut self) -> Option<HashMap<u64, u32>> {
        let kept = |(hub, gateway): (&u64, &Gateway)| Some((*hub, gateway.stored_epoch.as_ref()?.epoch));
        std::mem::take(&mut self.is_epoch_new).then(|| self.gateways.iter().filter_map(kept).collect())
    }

    /// Keeps an authenticated epoch of `hub`. Anyone with the key can invent gateways, so the number of epochs is
    /// limited: the one that was stored first is forgotten.
    fn store_epoch(&mut self, hub: u64, epoch: u32) {
        let order = self.order();
        let gateway = self.gateways.entry(hub).or_default();
        if let Some(stored) = &mut gateway.stored_epoch {
            self.is_epoch_new |= epoch > stored.epoch;
            stored.epoch = epoch.max(stored.epoch);
            return;
        }
        gateway.stored_epoch = Some(StoredEpoch { epoch, order });
        self.is_epoch_new = true;
        self.epoch_count += 1;
        if self.epoch_count > MAX_EPOCHS {
            let order = |gateway: &Gateway| gateway.stored_epoch.as_ref().map(|kept| kept.order);
            let kept = self.gateways.iter().filter_map(|(hub, gateway)| Some((order(gateway)?, *hub)));
            if let Some((_, first)) = kept.min() {
                self.gateways.entry(first).and_modify(|gateway| gateway.stored_epoch = None);
                self.epoch_count -= 1;
                self.remove_if_unused(first);
            }
        }
    }

    /// Returns the active run with this number and epoch; `None` if it is not known yet. Returns
    /// [`DatagramError::Epoch`] if a run with a higher epoch is active.
    fn find(&self, (hub, epoch): RunId) -> Result<Option<&Run>, DatagramError> {
        match self.gateways.get(&hub).and_then(|gateway| gateway.runs.last_key_value()) {
            Some((active, _)) if *active > epoch => Err(DatagramError::Epoch),
            Some((active, run)) if *active == epoch => Ok(Some(run)),
            _ => Ok(None),
        }
    }

    fn run(&self, (hub, epoch): RunId) -> Option<&Run> {
        self.gateways.get(&hub)?.runs.get(&epoch)
    }

    fn run_mut(&mut self, (hub, epoch): RunId) -> Option<&mut Run> {
        self.gateways.get_mut(&hub)?.runs.get_mut(&epoch)
    }

    fn sensor(&self, hub: u64, epoch: u32, sensor: u8) -> Option<&Sensor> {
        self.run((hub, epoch))?.sensors.get(&sensor)
    }

    /// Returns the row of the sensor that sent `head` for `topic`, or a new row that starts with `first`. `None` if
    /// there is no room for a new row.
    fn row(&mut self, head: &Head, topic: u8, first: u32, arrival: Arrival) -> Option<&mut StreamCounters> {
        let Head { hub, epoch, sensor, .. } = *head;
        let known = self.sensor(hub, epoch, sensor);
        if known.is_none_or(|sensor| !sensor.rows.contains_key(&topic)) {
            // Evicting a run frees a row, because each run has at least one.
            if self.row_count == MAX_ROWS {
                self.evict((hub, epoch), arrival)?;
            }
            self.row_count += 1;
        }
        let sensors = &mut self.run_mut((hub, epoch))?.sensors;
        let rows = &mut sensors.entry(sensor).or_default().rows;
        Some(rows.entry(topic).or_insert_with(|| StreamCounters::new((hub, epoch, sensor, topic), first)))
    }

    /// Returns whether there is room for another row of `run_id`, or another run can be evicted for `arrival`.
    /// `is_known` is false if the run itself is new.
    fn has_room(&self, run_id: RunId, is_known: bool, arrival: Arrival) -> bool {
        let (hub, epoch) = run_id;
        let is_full = self.row_count == MAX_ROWS || !is_known && self.run_count == MAX_RUNS;
        let retires_another = || self.gateways.get(&hub).is_some_and(|gateway| gateway.has_before(epoch));
        !is_full || retires_another() || self.next_evicted(run_id, arrival).is_some()
    }

    /// Begins a run, and retires the active run of its gateway. If there are too many runs, evicts one of them, and
    /// returns its ID. The caller has checked that there is room or a run to evict.
    fn begin(&mut self, run_id: RunId, arrival: Arrival) -> Option<RunId> {
        let (hub, epoch) = run_id;
        let order = self.order();
        let runs = &mut self.gateways.entry(hub).or_default().runs;
        if let Some(mut last) = runs.last_entry() {
            // If the active run was removed, the last entry is a run that retired before. It keeps its order.
            last.get_mut().retired.get_or_insert(order);
        }
        runs.insert(epoch, Run::new(arrival.now_ns, order));
        self.run_count += 1;
        if self.run_count > MAX_RUNS { self.evict(run_id, arrival) } else { None }
    }

    /// Evicts a run to make room for `run_id`, to which `arrival` belongs, and returns the ID of the evicted run.
    /// Returns `None` if all other runs are active and none of them may be evicted, see
    /// [`EvictionRank::may_be_evicted`].
    fn evict(&mut self, run_id: RunId, arrival: Arrival) -> Option<RunId> {
        let (evicted, is_active) = self.next_evicted(run_id, arrival)?;
        self.end(evicted, is_active);
        self.remove_if_unused(evicted.0);
        Some(evicted)
    }

    /// Returns the run that is evicted next to make room for `run_id`, and whether it is still active.
    fn next_evicted(&self, run_id: RunId, arrival: Arrival) -> Option<(RunId, bool)> {
        let all = self
            .gateways
            .iter()
            .flat_map(|(hub, gateway)| gateway.runs.iter().map(move |(epoch, run)| ((*hub, *epoch), run)));
        let may_go = all
            .filter(|&(id, run)| id != run_id && (run.retired.is_some() || run.rank.may_be_evicted(arrival)));
        let rank = |run: &Run| match run.retired {
            Some(retired) => (false, 0, retired),
            None => (true, run.rank.active_until_ns(), run.accepted),
        };
        may_go.min_by_key(|(_, run)| rank(run)).map(|(id, run)| (id, run.retired.is_none()))
    }

    /// Removes a run, and adds its counters to the totals.
    fn end(&mut self, (hub, epoch): RunId, is_active: bool) {
        let Some(run) = self.gateways.get_mut(&hub).and_then(|gateway| gateway.runs.remove(&epoch)) else {
            return;
        };
        let totals = &mut self.evicted;
        totals.runs += 1;
        totals.evicted_active += u64::from(is_active);
        for row in run.rows() {
            totals.received += row.received;
            totals.lost += row.lost();
            totals.duplicate += row.duplicate;
            totals.reordered += row.reordered;
        }
        self.run_count -= 1;
        self.row_count -= run.rows().count();
    }

    /// Forgets a gateway without runs, unless its epoch is kept or it was reported that its clock differs. Adds its
    /// counter to the totals.
    fn remove_if_unused(&mut self, hub: u64) {
        let is_unused = |gateway: &Gateway| {
            gateway.runs.is_empty() && gateway.stored_epoch.is_none() && !gateway.is_clock_reported
        };
        if self.gateways.get(&hub).is_some_and(is_unused) {
            let forgotten = self.gateways.remove(&hub);
            self.evicted.no_room += forgotten.map_or(0, |gateway| gateway.no_room);
        }
    }

    fn order(&mut self) -> u64 {
        self.next_order += 1;
        self.next_order
    }
}

impl Gateway {
    /// Returns whether the gateway's active run has a lower epoch than `epoch`.
    fn has_before(&self, epoch: u32) -> bool {
        self.runs.last_key_value().is_some_and(|(active, _)| *active < epoch)
    }
}

impl Run {
    fn new(since_ns: u64, accepted: u64) -> Run {
        let (rank, senders, delays) = (EvictionRank::NONE, Senders::NONE, Delays::default());
        Run { since_ns, accepted, retired: None, rank, senders, delays, sensors: BTreeMap::new() }
    }

    fn rows(&self) -> impl Iterator<Item = &StreamCounters> {
        self.sensors.values().flat_map(|sensor| sensor.rows.values())
    }

    /// Returns the row of the sensor and topic of `head`.
    fn row(&self, head: &Head) -> Option<&StreamCounters> {
        self.sensors.get(&head.sensor)?.rows.get(&head.topic)
    }
}

/// Kind and time of a received datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Arrival {
    /// Whether the datagram is a sample rather than an announcement.
    pub(super) is_sample: bool,
    /// Time of arrival, in ns of a clock that is never set.
    pub(super) now_ns: u64,
}

/// Rank by which runs are compared if one of them must be evicted to make room for another run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct EvictionRank {
    last_datagram_ns: u64,
    /// Times of the first and the last sample.
    delivered_ns: Option<(u64, u64)>,
}

/// Minimum time between the first and the last sample of a run that is known to deliver, in ns.
const MIN_PROVEN_NS: u64 = 1_000_000_000;
/// Time for which a run that is known to deliver keeps its rank after its last sample, in ns.
const RANK_LIFETIME_NS: u64 = 60_000_000_000;

impl EvictionRank {
    /// Rank of a run from which nothing was accepted.
    pub(super) const NONE: EvictionRank = EvictionRank { last_datagram_ns: 0, delivered_ns: None };

    /// Records that a datagram was accepted.
    pub(super) fn take(&mut self, arrival: Arrival) {
        let now_ns = arrival.now_ns;
        self.last_datagram_ns = now_ns;
        if arrival.is_sample {
            self.delivered_ns = Some((self.delivered_ns.map_or(now_ns, |(first_ns, _)| first_ns), now_ns));
        }
    }

    /// Returns whether this run may be evicted for the run to which `arrival` belongs. A run may be evicted if it has
    /// not delivered for 3 s. If `arrival` is a sample, a run that has delivered for less than a second may be evicted,
    /// too.
    pub(super) fn may_be_evicted(&self, arrival: Arrival) -> bool {
        let silent_ns = |(_, last_ns): (u64, u64)| arrival.now_ns.saturating_sub(last_ns);
        let is_busy = self.delivered_ns.is_some_and(|delivered_ns| silent_ns(delivered_ns) < SILENCE_NS);
        !is_busy || arrival.is_sample && !self.is_proven()
    }

    /// Returns the time until which the run counts as active. Among the runs that may be evicted, the one with the
    /// lowest value is evicted first.
    pub(super) fn active_until_ns(&self) -> u64 {
        match self.delivered_ns {
            None => self.last_datagram_ns,
            Some((_, last_ns)) => last_ns + if self.is_proven() { RANK_LIFETIME_NS } else { SILENCE_NS },
        }
    }

    /// Returns whether the run is known to deliver: a second or more passed between its first and its last sample.
    pub(super) fn is_proven(&self) -> bool {
        self.delivered_ns.is_some_and(|(first_ns, last_ns)| last_ns.saturating_sub(first_ns) >= MIN_PROVEN_NS)
    }
}

/// Delays of the last announcements of a run. An announcement is stamped when it is sent, so its delay is the transit
/// time plus the difference of the clocks. The shortest delay is used, because the network has disturbed it least.
#[derive(Default)]
struct Delays {
    last_ns: [i64; MAX_DELAYS],
    count: usize,
}

/// Number of announcements whose delays are kept. For a gateway with two sensors, these are the announcements of five
/// seconds.
const MAX_DELAYS: usize = 10;
/// Maximum difference, in ns, of clocks that are treated as one. The difference is an error of the age of a sample.
/// That age is at least the time that a telegram takes on its line, which is 15 ms or more.
const MAX_CLOCK_DIFFERENCE_NS: u64 = 20_000_000;

impl Delays {
    fn add(&mut self, delay_ns: i64) {
        self.last_ns[self.count % MAX_DELAYS] = delay_ns;
        self.count += 1;
    }

    /// Returns by how much this machine's clock is ahead of the gateway's, plus the shortest transit time, in ns.
    /// `None` before the first announcement.
    fn difference_ns(&self) -> Option<i64> {
        self.last_ns[..self.count.min(MAX_DELAYS)].iter().min().copied()
    }

    fn clocks_agree(&self) -> bool {
        self.difference_ns()
            .is_some_and(|difference_ns| difference_ns.unsigned_abs() <= MAX_CLOCK_DIFFERENCE_NS)
    }
}

#[cfg(test)]
mod tests {
    use scanhub_schema::Zones;
    use scanhub_schema::datagram::{Announced, DatagramPayload, HEADER_LEN};

    use super::*;

    fn zones(head: Head) -> Vec<u8> {
        let mut buffer = [0; 100];
        let len = Zones::unknown().pack(&mut buffer[HEADER_LEN..]).unwrap();
        head.seal(&mut buffer, len).unwrap().to_vec()
    }

    fn head(hub: u64, epoch: u32, sequence: u32) -> Head {
        Head { topic: Topic::Zones.number(), revision: 1, hub, epoch, sequence, ..Head::default() }
    }

    fn announce(hub: u64, next: u32) -> Vec<u8> {
        let mut announce = Announce::new(1, "front", "");
        for topic in [Topic::Zones, Topic::Telegram] {
            announce.add(Announced { topic: topic.number(), group: 81, port: 22_200, next });
        }
        let mut buffer = [0; 200];
        let len = announce.pack(&mut buffer[HEADER_LEN..]).unwrap();
        Head { topic: 0, ..head(hub, 1, 0) }.seal(&mut buffer, len).unwrap().to_vec()
    }

    fn fresh(table: &mut GatewayTable, bytes: &[u8]) -> Result<SequenceStatus, DatagramError> {
        at(table, bytes, 0)
    }

    fn at(table: &mut GatewayTable, bytes: &[u8], now_ms: u64) -> Result<SequenceStatus, DatagramError> {
        table.receive(bytes, 1, now_ms * 1_000_000).map(|(_, fresh)| fresh)
    }

    fn knows(table: &GatewayTable, hub: u64, epoch: u32) -> bool {
        table.since_ns(hub, epoch).is_some()
    }

    /// Returns a table with 64 gateways that are known to deliver.
    fn full() -> GatewayTable {
        let mut table = GatewayTable::new(&Topic::ALL);
        for (number, now_ms) in [(0, 0), (1, 1000)] {
            for hub in 0..64 {
                assert_eq!(at(&mut table, &zones(head(hub, 1, number)), now_ms), Ok(SequenceStatus::New));
            }
        }
        table
    }

    const MS: u64 = 1_000_000;

    fn announces(at_ms: u64) -> Arrival {
        Arrival { is_sample: false, now_ns: at_ms * MS }
    }

    fn delivers(at_ms: u64) -> Arrival {
        Arrival { is_sample: true, now_ns: at_ms * MS }
    }

    /// Accepts a datagram of a known or unknown run. Returns the run that was evicted for it.
    fn receive(table: &mut GatewayTable, run: RunId, arrival: Arrival) -> Option<RunId> {
        let evicted = match table.find(run) {
            Ok(Some(_)) => None,
            _ => table.begin(run, arrival),
        };
        table.run_mut(run).unwrap().rank.take(arrival);
        evicted
    }

    fn is_over(table: &GatewayTable, run: RunId) -> bool {
        table.find(run).is_err()
    }

    fn contains(table: &GatewayTable, (hub, epoch): RunId) -> bool {
        knows(table, hub, epoch)
    }

    fn is_full(table: &GatewayTable) -> bool {
        table.run_count == MAX_RUNS
    }

    #[test]
    fn higher_epoch_retires_the_lower_one() {
        let mut table = GatewayTable::new(&Topic::ALL);
        for (hub, epoch, expected) in [
            (1, 7, Ok(SequenceStatus::New)),
            (2, 3, Ok(SequenceStatus::New)),
            (1, 6, Err(DatagramError::Epoch)),
            (1, 8, Ok(SequenceStatus::New)),
            (1, 7, Err(DatagramError::Epoch)),
            (2, 3, Ok(SequenceStatus::Duplicate)),
        ] {
            assert_eq!(fresh(&mut table, &zones(head(hub, epoch, 0))), expected, "{hub} {epoch}");
        }
        let rows: Vec<_> = table.rows().map(|row| (row.hub, row.epoch, row.received)).collect();
        assert_eq!(rows, [(1, 7, 1), (1, 8, 1), (2, 3, 1)]);
        assert_eq!(table.refused(DatagramError::Epoch), 2);
    }

    #[test]
    fn refused_datagrams_change_nothing() {
        let mut table = GatewayTable::new(&Topic::ALL);
        let damaged = |head: Head| {
            let mut buffer = [0; 60];
            head.seal(&mut buffer, 3).unwrap().to_vec()
        };
        let refused = [
            (DatagramError::Payload, damaged(head(1, 2, 0))),
            (DatagramError::Payload, zones(Head { revision: 0, ..head(1, 2, 0) })),
            (DatagramError::Skipped, zones(Head { topic: 255, revision: 0, ..head(1, 2, 0) })),
        ];
        for (refusal, bytes) in &refused {
            assert_eq!(fresh(&mut table, bytes), Err(*refusal));
        }
        assert_eq!(table.rows().count(), 0);
        assert_eq!(fresh(&mut table, &zones(head(1, 1, 0))), Ok(SequenceStatus::New), "epoch 2 was refused");
        assert_eq!(table.refused(DatagramError::Payload), 2);
    }

    #[test]
    fn memory_is_bounded() {
        let mut table = full();
        assert_eq!(at(&mut table, &zones(head(64, 1, 0)), 1000), Err(DatagramError::Capacity));
        assert_eq!(
            at(&mut table, &zones(head(1, 1, 2)), 1000),
            Ok(SequenceStatus::New),
            "known gateways continue"
        );
        for sensor in 1..=240 {
            for hub in 0..4 {
                let bytes = zones(Head { sensor, ..head(hub, 1, 0) });
                assert_eq!(at(&mut table, &bytes, 1000), Ok(SequenceStatus::New));
            }
        }
        let more = zones(Head { sensor: 241, ..head(1, 1, 0) });
        assert_eq!(at(&mut table, &more, 3999), Err(DatagramError::Capacity));
        assert_eq!((table.rows().count(), table.refused(DatagramError::Capacity)), (MAX_ROWS, 2));
        assert_eq!(table.evicted(), EvictedTotals::default());
        // Runs that were silent for three seconds make room. The totals keep their received samples.
        assert_eq!(at(&mut table, &more, 4000), Ok(SequenceStatus::New));
        assert_eq!(at(&mut table, &zones(head(64, 1, 0)), 4000), Ok(SequenceStatus::New));
        let sum = table.evicted();
        assert_eq!(
            (sum.runs, sum.evicted_active, sum.lost),
            (1, 1, 0),
            "the run that was evicted for the row left a place"
        );
        let counted: u64 = table.rows().map(|row| row.received).sum();
        assert_eq!(counted + sum.received, 128 + 1 + 4 * 240 + 2);
    }

    #[test]
    fn accepts_gateway_after_many_invented_ones() {
        let mut table = GatewayTable::new(&Topic::ALL);
        for number in 0..2 {
            assert_eq!(
                at(&mut table, &zones(head(9999, 1, number)), 1000 * u64::from(number)),
                Ok(SequenceStatus::New)
            );
        }
        for (now_ms, bytes) in [(1001, announce(0, 10)), (1002, zones(head(0, 1, 0)))] {
            for hub in 0..1000 {
                let mut forged = bytes.clone();
                forged[8..10].copy_from_slice(&(hub as u16).to_le_bytes());
                let Datagram { mut head, payload, .. } = Datagram::read(&bytes).unwrap();
                head.hub = hub;
                forged[HEADER_LEN..].copy_from_slice(payload);
                let forged = head.seal(&mut forged, payload.len()).unwrap();
                assert!(at(&mut table, forged, now_ms).is_ok());
            }
        }
        assert_eq!(at(&mut table, &zones(head(7777, 1, 0)), 1003), Ok(SequenceStatus::New));
        assert!(knows(&table, 9999, 1) && knows(&table, 7777, 1), "{:?}", table.evicted());
        assert_eq!(table.evicted().evicted_active, table.evicted().runs);
    }

    #[test]
    fn never_mixes_gateways_with_one_number_and_epoch() {
        let mut table = GatewayTable::new(&Topic::ALL);
        let mut hear = |from: u64, bytes: &[u8], now_ms: u64| {
            table.receive(bytes, from, now_ms * 1_000_000).map(|(_, fresh)| fresh)
        };
        let announce = |boot: u64, number: u32| {
            let mut buffer = [0; 200];
            let len = Announce::new(boot, "front", "").pack(&mut buffer[HEADER_LEN..]).unwrap();
            Head { topic: 0, ..head(5, 1, number) }.seal(&mut buffer, len).unwrap().to_vec()
        };
        for n in 0..30_u32 {
            let now_ms = 100 * u64::from(n);
            if n % 10 == 0 {
                assert_eq!(hear(1, &announce(7, n / 10), now_ms), Ok(SequenceStatus::New));
                assert_eq!(hear(2, &announce(8, n / 10), now_ms), Err(DatagramError::Twin));
            }
            assert_eq!(hear(1, &zones(head(5, 1, n)), now_ms), Ok(SequenceStatus::New));
            assert_eq!(hear(2, &zones(head(5, 1, 500 + n)), now_ms + 50), Err(DatagramError::Twin));
        }
        // The second gateway continues alone. It never replaces the first one.
        assert_eq!(hear(2, &zones(head(5, 1, 100)), 5899), Err(DatagramError::Twin));
        assert_eq!(hear(2, &zones(head(5, 1, 101)), 60_000), Err(DatagramError::Twin));
        assert_eq!(hear(1, &zones(head(5, 1, 30)), 60_001), Ok(SequenceStatus::New));
        assert!(table.is_shared(5, 1));
        assert_eq!(table.refused(DatagramError::Twin), 35);
    }

    #[test]
    fn successor_of_a_silent_gateway_begins_a_run() {
        let mut table = GatewayTable::new(&Topic::ALL);
        let mut hear = |from: u64, bytes: &[u8], now_ms: u64| {
            table.receive(bytes, from, now_ms * 1_000_000).map(|(_, fresh)| fresh)
        };
        for n in 0..30 {
            assert_eq!(hear(1, &zones(head(5, 1, 200 + n)), 100 * u64::from(n)), Ok(SequenceStatus::New));
        }
        // The numbers of the second gateway start a new run, and no numbers in between count as lost.
        assert_eq!(hear(2, &zones(head(5, 1, 100)), 5899), Err(DatagramError::Twin));
        assert_eq!(hear(2, &zones(head(5, 1, 101)), 5900), Ok(SequenceStatus::New));
        assert!(!table.is_shared(5, 1), "a new run");
        let rows: Vec<_> = table.rows().map(|row| (row.received, row.lost())).collect();
        assert_eq!(rows, [(1, 0)]);
        let evicted = table.evicted();
        assert_eq!((evicted.runs, evicted.evicted_active, evicted.received, evicted.lost), (1, 0, 30, 0));
        assert_eq!(table.refused(DatagramError::Twin), 1);
    }

    #[test]
    fn evicted_retired_runs_remain_in_totals() {
        let mut table = full();
        let fresh = |table: &mut GatewayTable, bytes: &[u8]| at(table, bytes, 1000);
        assert_eq!(fresh(&mut table, &zones(head(5, 1, 4))), Ok(SequenceStatus::New));
        // A gateway that restarts is accepted even though the table is full.
        assert_eq!(fresh(&mut table, &zones(head(5, 2, 0))), Ok(SequenceStatus::New));
        let mut evicted = EvictedTotals { runs: 1, received: 3, lost: 2, ..EvictedTotals::default() };
        assert_eq!((table.evicted(), table.rows().count()), (evicted, 64));
        assert_eq!(
            fresh(&mut table, &zones(head(5, 1, 5))),
            Err(DatagramError::Epoch),
            "its epoch is still known"
        );
        assert!(knows(&table, 5, 2) && !knows(&table, 5, 1));
        // A damaged datagram evicts nothing.
        let mut buffer = [0; 60];
        let damaged = head(5, 3, 0).seal(&mut buffer, 3).unwrap();
        assert_eq!(fresh(&mut table, damaged), Err(DatagramError::Payload));
        assert!(knows(&table, 5, 2) && !knows(&table, 5, 3));
        // Fill the table with sensors of four runs. One of these runs then retires, and the row of its next run evicts
        // it.
        for sensor in 1..=240 {
            for hub in 0..4 {
                let bytes = zones(Head { sensor, ..head(hub, 1, 0) });
                assert_eq!(fresh(&mut table, &bytes), Ok(SequenceStatus::New));
            }
        }
        assert_eq!(fresh(&mut table, &zones(head(2, 9, 0))), Ok(SequenceStatus::New));
        evicted = EvictedTotals { runs: 2, received: 3 + 242, ..evicted };
        assert_eq!((table.evicted(), table.rows().count()), (evicted, MAX_ROWS - 240));
        let counted: u64 = table.rows().map(|row| row.received).sum();
        assert_eq!(counted + evicted.received, 128 + 2 + 4 * 240 + 1);
    }

    #[test]
    fn announcements_count_for_joined_topics() {
        let mut table = GatewayTable::new(&[Topic::Zones]);
        assert_eq!(fresh(&mut table, &announce(1, 10)), Ok(SequenceStatus::New));
        assert_eq!(table.rows().map(|row| row.topic).collect::<Vec<_>>(), [0], "no samples yet");
        assert_eq!(fresh(&mut table, &announce(1, 12)), Ok(SequenceStatus::Duplicate));
        let rows: Vec<_> = table.rows().map(|row| (row.topic, row.received, row.lost())).collect();
        assert_eq!(rows, [(0, 1, 0), (Topic::Zones.number(), 0, 2)]);
    }

    #[test]
    fn evicts_the_run_that_retired_first() {
        let mut table = GatewayTable::new(&Topic::ALL);
        for run in [(1, 5), (2, 5), (3, 5), (2, 6), (1, 9), (2, 7)] {
            assert_eq!(receive(&mut table, run, delivers(0)), None);
        }
        assert!(contains(&table, (2, 5)) && is_over(&table, (1, 8)) && !is_over(&table, (1, 9)));
        let mut evict = || {
            let evicted_active = table.evicted().evicted_active;
            table
                .evict((9, 9), announces(0))
                .map(|run| (run, table.evicted().evicted_active > evicted_active))
        };
        let retired = [(2, 5), (1, 5), (2, 6)].map(|run| Some((run, false)));
        assert_eq!([(); 3].map(|()| evict()), retired);
        assert_eq!(evict(), None, "the others deliver");
        assert!(
            is_over(&table, (2, 6)) && !contains(&table, (2, 6)),
            "its gateway continues with a higher epoch"
        );
        assert!(contains(&table, (1, 9)) && contains(&table, (2, 7)) && contains(&table, (3, 5)));
    }

    #[test]
    fn restarted_gateway_evicts_its_own_earlier_run() {
        let mut table = GatewayTable::new(&Topic::ALL);
        for hub in 0..MAX_RUNS as u64 {
            assert!(!is_full(&table));
            assert_eq!(receive(&mut table, (hub, 1), delivers(0)), None);
            receive(&mut table, (hub, 1), delivers(1000));
        }
        let now = delivers(1001);
        assert!(
            is_full(&table) && !table.has_room((99, 1), false, now) && table.has_room((7, 2), false, now)
        );
        assert_eq!(receive(&mut table, (7, 2), now), Some((7, 1)));
        assert!(
            is_full(&table) && is_over(&table, (7, 1)) && !table.has_room((9, 1), false, announces(1002))
        );
    }

    #[test]
    fn announcements_never_evict_a_delivering_run() {
        let mut table = GatewayTable::new(&Topic::ALL);
        assert_eq!(receive(&mut table, (1, 1), delivers(0)), None);
        assert_eq!(receive(&mut table, (2, 1), delivers(0)), None);
        for n in 1..30_000 {
            // Gateway 1 delivers ten times a second. Gateway 2 has delivered once. Every millisecond, an attacker
            // invents a further gateway.
            if n % 100 == 0 {
                assert_eq!(receive(&mut table, (1, 1), delivers(n)), None, "{n}");
            }
            let evicted = receive(&mut table, (1000 + n, 1), announces(n));
            assert!(evicted.is_none_or(|(hub, _)| hub >= 1000 || hub == 2 && n >= 3000), "{n}: {evicted:?}");
        }
        assert!(contains(&table, (1, 1)) && !contains(&table, (2, 1)));
    }

    #[test]
    fn proven_run_is_not_evicted_for_a_new_one() {
        let mut table = GatewayTable::new(&Topic::ALL);
        let mut evicted_active = 0;
        for n in 0..30_000 {
            if n % 100 == 0 && !(10_000..20_000).contains(&n) {
                assert_eq!(receive(&mut table, (1, 1), delivers(n)), None, "{n}: its silence is too short");
            }
            if n > 1000 {
                evicted_active += u32::from(receive(&mut table, (1000 + n, 1), delivers(n)).is_some());
            }
        }
        assert!(contains(&table, (1, 1)) && evicted_active > 28_000);
    }

    #[test]
    fn evicts_the_longest_silence_first() {
        let mut table = GatewayTable::new(&Topic::ALL);
        for hub in 0..MAX_RUNS as u64 {
            for at_ms in [0, 2000 + hub] {
                assert_eq!(receive(&mut table, (hub, 1), delivers(at_ms)), None);
            }
        }
        assert!(!table.has_room((99, 1), false, delivers(4999)));
        assert_eq!(receive(&mut table, (99, 1), delivers(5000)), Some((0, 1)));
        assert_eq!(receive(&mut table, (100, 1), announces(6000)), Some((1, 1)));
        assert_eq!(receive(&mut table, (101, 1), announces(6001)), Some((100, 1)), "it never delivered");
    }

    #[test]
    fn announcement_sets_the_sensor_name() {
        let mut table = GatewayTable::new(&Topic::ALL);
        let head = Head { sensor: 1, ..head(5, 9, 0) };
        table.begin((5, 9), delivers(0));
        assert_eq!((table.printed_name(&head).as_str(), table.name(5, 9, 1).as_str()), ("#1", "#1"));
        let is_named =
            |table: &mut GatewayTable, name| table.announce(&head, &Announce::new(3, name, ""), 0).1;
        assert_eq!([is_named(&mut table, "rear"), is_named(&mut table, "rear")], [true, false]);
        assert_eq!((table.name(5, 9, 1).as_str(), table.name(5, 8, 1).as_str()), ("rear", "#1"));
    }

    #[test]
    fn counters_of_a_reused_sensor_number_have_no_name() {
        let mut table = GatewayTable::new(&Topic::ALL);
        let row = StreamCounters::new((5, 9, 0, 4), 0);
        table.begin((5, 9), delivers(0));
        let mut announce = |boot, name| {
            table.announce(&head(5, 9, 0), &Announce::new(boot, name, ""), 0);
            (table.name(5, 9, 0), table.row_name(&row))
        };
        assert_eq!(announce(3, "front"), ("front".into(), "front".into()));
        assert_eq!(announce(4, "front"), ("front".into(), "front".into()), "the hub's next run");
        assert_eq!(announce(5, "rear"), ("rear".into(), "#0".into()));
        assert_eq!(announce(6, "front"), ("front".into(), "#0".into()));
    }

    #[test]
    fn evicted_runs_have_no_names() {
        let mut table = GatewayTable::new(&Topic::ALL);
        for epoch in 1..300 {
            table.receive(&zones(head(5, epoch, 0)), 1, 0).unwrap();
            table.announce(&head(5, epoch, 0), &Announce::new(3, "rear", ""), 0);
        }
        assert_eq!((table.run_count, table.evicted().runs), (MAX_RUNS, 299 - MAX_RUNS as u64));
        assert_eq!((table.name(5, 299, 0).as_str(), table.name(5, 1, 0).as_str()), ("rear", "#0"));
    }

    #[test]
    fn differing_clocks_give_no_age_and_are_reported_once() {
        let mut table = GatewayTable::new(&Topic::ALL);
        let head = |epoch, stamp_ms| Head { stamp_ns: stamp_ms * MS, ..head(5, epoch, 0) };
        let age_ns = |table: &GatewayTable, stamp_ms, wall_ms| table.age_ns(&head(1, stamp_ms), wall_ms * MS);
        let announce = |table: &mut GatewayTable, epoch, stamp_ms, wall_ms| {
            if table.run((5, epoch)).is_none() {
                table.begin((5, epoch), delivers(0));
            }
            table.announce(&head(epoch, stamp_ms), &Announce::new(1, "front", ""), wall_ms * MS).0
        };
        assert_eq!(age_ns(&table, 1, 2), None, "not known yet");
        assert_eq!(announce(&mut table, 1, 100, 101), None);
        assert_eq!((age_ns(&table, 200, 230), age_ns(&table, 200, 199)), (Some(30 * MS), None));
        assert_eq!(announce(&mut table, 1, 100, 900), None, "an announcement that waited");
        assert_eq!(announce(&mut table, 1, 3000, 1000), Some(-2000 * MS as i64));
        assert_eq!(announce(&mut table, 1, 4000, 2000), None);
        assert_eq!(age_ns(&table, 5000, 3030), None);
        assert!((2..1000).all(|epoch| announce(&mut table, epoch, 3000, 1000).is_none()), "the same gateway");
    }

    #[test]
    fn evicted_gateways_keep_counters_and_clock_reports() {
        let mut table = GatewayTable::new(&Topic::ALL);
        let differing = |hub, epoch| Head { stamp_ns: 3_000 * MS, ..head(hub, epoch, 0) };
        let announce = |table: &mut GatewayTable, hub, epoch, at_ms| {
            receive(table, (hub, epoch), announces(at_ms));
            table.announce(&differing(hub, epoch), &Announce::new(1, "front", ""), 1_000 * MS).0
        };
        assert_eq!(announce(&mut table, 5, 1, 0), Some(-2_000 * MS as i64));
        table.count_no_room(5);
        table.count_no_room(5);
        // Gateways whose clocks were not reported are dropped with their last run.
        receive(&mut table, (6, 1), announces(0));
        table.count_no_room(6);
        for hub in 0..MAX_RUNS as u64 {
            receive(&mut table, (100 + hub, 1), announces(1 + hub));
        }
        assert!(!contains(&table, (5, 1)) && !contains(&table, (6, 1)));
        let counted = table.evicted().no_room + table.no_room().map(|(_, count)| count).sum::<u64>();
        assert_eq!(counted, 3);
        assert_eq!(announce(&mut table, 5, 2, 1_000), None, "reported before");
        // However many gateways have other clocks, the number that is reported and kept is limited.
        let reported = (1_000..2_000).filter(|&hub| announce(&mut table, hub, 1, hub).is_some()).count();
        assert_eq!(reported, MAX_RUNS - 1);
        assert!(table.gateways.len() <= 2 * MAX_RUNS, "{}", table.gateways.len());
    }

    #[test]
    fn successor_of_a_gateway_keeps_order_of_retired_runs() {
        let mut table = GatewayTable::new(&Topic::ALL);
        for (hub, epoch) in [(5, 1), (5, 2), (6, 1), (6, 2)] {
            assert_eq!(at(&mut table, &zones(head(hub, epoch, 0)), 0), Ok(SequenceStatus::New));
        }
        let (fresh, now_ns) = (zones(head(5, 2, 0)), 6_000 * MS);
        assert!(table.receive(&fresh, 2, now_ns).is_ok_and(|(_, fresh)| fresh == SequenceStatus::New));
        assert_eq!(table.evicted().runs, 1, "the silent run has ended");
        let evicted = [(); 2].map(|()| table.evict((9, 9), announces(6_000)));
        assert_eq!(evicted, [Some((5, 1)), Some((6, 1))], "the run that retired first goes first");
    }

    #[test]
    fn epochs_of_gateways_with_the_key_are_bounded() {
        let epochs = (0..2000).map(|hub| (hub, 2000 - hub as u32)).collect();
        let mut table = GatewayTable::new(&Topic::ALL).with_key(epochs);
        assert_eq!(table.take_epochs(), None);
        table.store_epoch(10_000, 1);
        let kept = table.take_epochs().unwrap();
        assert_eq!((kept.len(), kept.get(&0), kept.get(&1023)), (MAX_EPOCHS, Some(&2000), None));
        (20_000..25_000).for_each(|hub| table.store_epoch(hub, 1));
        let kept = table.take_epochs().unwrap();
        assert_eq!((kept.len(), kept.contains_key(&24_999)), (MAX_EPOCHS, true));
        assert_eq!(table.gateways.len(), MAX_EPOCHS);
    }
}

//! Writers of the output formats of a conversion: a stream of telegrams, a CARMEN log, MCAP, messages of ROS 2, and CSV
//! of scans or marks.

use std::collections::BTreeMap;
use std::io::{self, Write};

use mcap::records::{Record as Parsed, op};
use scanhub_drivers::lms::variant::Baud;
use scanhub_ros::bag::{self, BagWriter};
use scanhub_schema::csv::{MarkColumns, ScanColumns};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::{METADATA, Writer};
use scanhub_schema::{Failure, Flags, Header, Kind, Marks, Topic};

use super::scans::{self, DecodedItem, SyntheticClock, stream_heads};
use super::{Conversion, ConversionError, OutputEncoder, WrittenItem, form_name};
use crate::mcap::{Catalog, Item, Record, Sample};
use crate::{Encoding, Form, Frame, Recording, carmen};

/// Writes a stream of telegrams.
pub(super) fn write_stream(
    conversion: &mut Conversion,
    mut out: OutputEncoder<impl Write>,
) -> Result<(), ConversionError> {
    let recording = conversion.recording;
    let mut heads = stream_heads(recording)?.into_iter().peekable();
    for (number, frame) in frames(recording, conversion.encoding)?.enumerate() {
        let head = heads.next_if(|(before, _)| *before == number).map(|(_, head)| head).unwrap_or_default();
        out.write_all(&head)?;
        out.write_all(&frame.telegram)?;
        let form = recording.contents().form;
        conversion.count(WrittenItem::of_frame(form, number, &frame), frame.wall_ns)?;
    }
    out.finish()?;
    Ok(())
}

/// Writes a CARMEN log.
pub(super) fn write_log(
    conversion: &mut Conversion,
    mut out: OutputEncoder<impl Write>,
) -> Result<(), ConversionError> {
    let (recording, encoding) = (conversion.recording, conversion.encoding);
    let mut clock = SyntheticClock::of(recording);
    let first_line = carmen::encoding_line(encoding);
    out.write_all(first_line.as_bytes())?;
    let mut first_ns = None;
    for (number, frame) in recording.telegrams(encoding)?.enumerate() {
        let at_ns = clock.wall_ns(&frame);
        // The first line of the log already has the encoding.
        if number == 0 && is_synthetic(&frame.telegram, frame.header.as_ref()) {
            continue;
        }
        let line = carmen::scan_line(&frame.telegram, encoding.mode, at_ns, *first_ns.get_or_insert(at_ns));
        out.write_all(line.as_deref().unwrap_or_default().as_bytes())?;
        conversion
            .count(if line.is_some() { WrittenItem::Scan } else { WrittenItem::Dropped }, Some(at_ns))?;
    }
    out.finish()?;
    Ok(())
}

/// Writes telegrams that have no header into an MCAP file.
pub(super) fn write_mcap(conversion: &mut Conversion, file: &mut impl Write) -> Result<(), ConversionError> {
    let (recording, sensor) = (conversion.recording, conversion.sensor);
    conversion.converted.sensors = vec![sensor.to_owned()];
    let form = recording.contents().form;
    let metadata = [("converted from".to_owned(), form_name(form).to_owned())];
    let compression = conversion.options.compression.unwrap_or_default();
    let mut writer = Writer::begin_compressed(file, "", compression, metadata.into())?;
    let mut clock = SyntheticClock::of(recording);
    let mut bytes = 0;
    let mut frames = frames(recording, conversion.encoding)?.enumerate().peekable();
    while let Some((number, frame)) = frames.next() {
        let next_ns = frames.peek().and_then(|(_, next)| next.wall_ns);
        let header = clock.header(&frame, number as u64, next_ns);
        writer.write_sample(sensor, Topic::Telegram, &header, &frame.telegram)?;
        close_chunk(&mut writer, &mut bytes, frame.telegram.len())?;
        conversion.count(WrittenItem::of_frame(form, number, &frame), Some(header.wall_ns))?;
    }
    writer.finish()?;
    Ok(())
}

/// Adds `len` to `bytes`, the number of bytes in the open chunk of `writer`. Ends the chunk if it is large enough.
fn close_chunk<W: Write>(writer: &mut Writer<W>, bytes: &mut usize, len: usize) -> io::Result<()> {
    *bytes += len;
    if *bytes >= CHUNK_LEN {
        *bytes = 0;
        writer.close_chunk()?;
    }
    Ok(())
}

/// Returns the telegrams of `recording`. For a log, the first telegram is the reply that contains the encoding of the
/// values.
fn frames(recording: &Recording, encoding: Encoding) -> Result<impl Iterator<Item = Frame> + use<>, Failure> {
    let contents = recording.contents();
    let first = (contents.form == Form::Carmen).then(|| {
        let telegram = carmen::configuration(encoding);
        let took_ns = scanhub_schema::line_time(telegram.len(), Baud::B500000.rate());
        let wall_ns = contents.span.map(|(first_ns, _)| first_ns.saturating_sub(took_ns));
        Frame { telegram, wall_ns, ..Frame::default() }
    });
    Ok(first.into_iter().chain(recording.telegrams(encoding)?))
}

/// Returns whether `telegram`, the first one of a sensor, is the reply that [`frames`] adds to a log. No scanner sent
/// this reply, so it does not count as dropped if it is omitted.
pub(super) fn is_synthetic(telegram: &[u8], header: Option<&Header>) -> bool {
    let is_estimated = header.is_none_or(|header| header.flags & Flags::STAMP_ESTIMATED != 0);
    is_estimated && carmen::is_synthetic(telegram)
}

/// Copies an MCAP file: every readable message of all channels, including those of other programs, with a new index.
pub(super) fn copy(conversion: &mut Conversion, file: &mut impl Write) -> Result<(), ConversionError> {
    let recording = conversion.recording;
    let (mut reader, catalog) = recording.reader()?;
    let sensor = recording.selected_sensor();
    let compression = conversion.options.compression.unwrap_or_default();
    let writer = Writer::begin_compressed(file, &catalog.profile, compression, catalog.metadata.clone())?;
    let mut copy = Copy { writer, catalog, channels: BTreeMap::new(), has_metadata: false, bytes: 0 };
    while let Some(item) = reader.next().map_err(|error| recording.read_failure(&error))? {
        match item {
            Item::Telegram(sample) if sensor.is_none_or(|sensor| *sensor == sample.sensor) => {
                let Sample { sensor, header, telegram } = &sample;
                copy.writer.write_sample(sensor, Topic::Telegram, header, telegram)?;
                close_chunk(&mut copy.writer, &mut copy.bytes, telegram.len())?;
                let is_scan = crate::is_scan(header.family, telegram);
                conversion.count(WrittenItem::of(is_scan), Some(header.wall_ns))?;
            }
            Item::Telegram(_) => {}
            Item::Record(record) => {
                let channel = record
                    .message()
                    .and_then(|(message, _)| catalog.channel_topic(message.channel_id).flatten());
                let is_chosen =
                    sensor.is_none_or(|sensor| channel.is_some_and(|channel| channel.sensor == *sensor));
                if is_chosen || record.opcode != op::MESSAGE {
                    copy.record(&record)?;
                }
            }
        }
    }
    copy.writer.finish()?;
    Ok(())
}

struct Copy<'a, W: Write> {
    writer: Writer<W>,
    catalog: &'a Catalog,
    /// IDs of channels in the new file, by their IDs in the old file.
    channels: BTreeMap<u16, u16>,
    /// Whether the metadata of the old file was read. The new file begins with this metadata.
    has_metadata: bool,
    /// Number of bytes in the open chunk.
    bytes: usize,
}

impl<W: Write> Copy<'_, W> {
    fn record(&mut self, record: &Record) -> io::Result<()> {
        match record.opcode {
            op::MESSAGE => self.message(record),
            op::METADATA | op::ATTACHMENT => match record.parse() {
                Some(Parsed::Metadata(metadata)) if metadata.name == METADATA && !self.has_metadata => {
                    self.has_metadata = true;
                    Ok(())
                }
                Some(Parsed::Metadata(metadata)) => {
                    self.writer.write_metadata(&metadata.name, metadata.metadata)
                }
                Some(Parsed::Attachment { header, data, .. }) => {
                    self.writer.copy_attachment(&mcap::Attachment {
                        log_time: header.log_time,
                        create_time: header.create_time,
                        name: header.name,
                        media_type: header.media_type,
                        data,
                    })
                }
                _ => Ok(()),
            },
            _ => Ok(()),
        }
    }

    /// Copies a message, unless its channel is unknown.
    fn message(&mut self, record: &Record) -> io::Result<()> {
        let Some((mut head, data)) = record.message() else { return Ok(()) };
        head.channel_id = match self.channels.get(&head.channel_id) {
            Some(&id) => id,
            None => {
                let Some((channel, schema)) = self.catalog.channel(head.channel_id) else { return Ok(()) };
                let schema = schema.map(|(name, language, text)| (&name[..], &language[..], &text[..]));
                let id = self.writer.copy_channel(channel, schema)?;
                self.channels.insert(head.channel_id, id);
                id
            }
        };
        self.writer.copy_message(&head, data)?;
        close_chunk(&mut self.writer, &mut self.bytes, data.len())
    }
}

/// Writer of a format that contains decoded scans.
pub(super) trait ScanSink {
    /// Writes `item`, and returns its result. Returns `None` if `item` is not a telegram.
    fn write(&mut self, item: &DecodedItem<'_>) -> io::Result<Option<WrittenItem>>;

    /// Returns whether intensities were requested, but no scan had intensities.
    fn lacks_intensities(&self) -> bool {
        false
    }

    /// Writes the end of the file.
    fn finish(self) -> io::Result<()>;
}

/// Writes the scans into `sink`.
pub(super) fn write_scans(
    conversion: &mut Conversion,
    mut sink: impl ScanSink,
) -> Result<(), ConversionError> {
    let recording = conversion.recording;
    let (sensor, encoding, mode) = (conversion.sensor, conversion.encoding, conversion.options.mode);
    let mut is_empty = true;
    scans::for_each_item(recording, sensor, encoding, mode, &mut |item| {
        let Some(written) = sink.write(&item)? else { return Ok(()) };
        let DecodedItem::Scan(_, header, _) = item else { return conversion.count(written, None) };
        is_empty = false;
        conversion.count(written, Some(header.wall_ns))
    })?;
    if is_empty {
        let message = format!("there is no scan in {}", recording.path().display());
        let hint = "scans are decoded from topic telegram, or taken from topic scan";
        return Err(Failure::new(Kind::Input, message, hint).into());
    }
    if sink.lacks_intensities() {
        let message = format!("no scan in {} has intensities", recording.path().display());
        let hint = "leave --intensities out; an LMS sends reflector levels only in some measuring modes, such as 0x01";
        return Err(Failure::new(Kind::Input, message, hint).into());
    }
    sink.finish()?;
    Ok(())
}

/// Writer of an MCAP file with only messages of ROS 2.
pub(super) struct Ros2<W: Write> {
    writer: Writer<W>,
    bag: BagWriter,
    /// Whether each scan is also written as points.
    has_points: bool,
    /// Approximate number of bytes of scans in the open chunk.
    chunk_len: usize,
}

impl<W: Write> Ros2<W> {
    pub(super) fn begin(conversion: &Conversion, file: W) -> io::Result<Self> {
        let from = form_name(conversion.recording.contents().form);
        let metadata = [("converted from".to_owned(), from.to_owned())];
        let compression = conversion.options.compression.unwrap_or_default();
        Ok(Ros2 {
            writer: Writer::begin_compressed(file, bag::PROFILE, compression, metadata.into())?,
            bag: BagWriter::default(),
            has_points: conversion.options.points,
            chunk_len: 0,
        })
    }
}

impl<W: Write> ScanSink for Ros2<W> {
    fn write(&mut self, item: &DecodedItem<'_>) -> io::Result<Option<WrittenItem>> {
        match item {
            DecodedItem::Scan(sensor, header, scan) => {
                self.bag.write_scan(&mut self.writer, sensor, header, scan)?;
                let mut len = scan.beams() * size_of::<f32>();
                if self.has_points {
                    self.bag.write_points(&mut self.writer, sensor, header, scan)?;
                    len += scan.beams() * size_of::<[f32; 4]>();
                }
                close_chunk(&mut self.writer, &mut self.chunk_len, len)?;
                Ok(Some(WrittenItem::Scan))
            }
            DecodedItem::Pose(sensor, wall_ns, pose) => {
                self.bag.write_pose(&mut self.writer, sensor, *wall_ns, pose)?;
                Ok(None)
            }
            DecodedItem::Other => Ok(Some(WrittenItem::Dropped)),
        }
    }

    fn finish(self) -> io::Result<()> {
        self.writer.finish().map(drop)
    }
}

/// Writer of CSV with a row for each scan, after the names of the columns. The names are repeated if the number of
/// beams changes.
pub(super) struct Csv<W: Write> {
    out: OutputEncoder<W>,
    columns: ScanColumns,
    /// Number of beams in the last line of column names.
    beams: Option<usize>,
    has_intensities: bool,
    line: Vec<u8>,
}

impl<W: Write> Csv<W> {
    pub(super) fn begin(out: OutputEncoder<W>, columns: ScanColumns) -> Self {
        Csv { out, columns, beams: None, has_intensities: false, line: Vec::new() }
    }
}

impl<W: Write> ScanSink for Csv<W> {
    fn write(&mut self, item: &DecodedItem<'_>) -> io::Result<Option<WrittenItem>> {
        let DecodedItem::Scan(_, header, scan) = item else {
            return Ok(matches!(item, DecodedItem::Other).then_some(WrittenItem::Dropped));
        };
        self.line.clear();
        if self.beams != Some(scan.beams()) {
            self.beams = Some(scan.beams());
            self.columns.write_header(&mut self.line, scan.beams())?;
            self.line.push(b'\n');
        }
        self.has_intensities |= !scan.intensities().is_empty();
        self.columns.write_row(&mut self.line, header, scan)?;
        self.line.push(b'\n');
        self.out.write_all(&self.line)?;
        Ok(Some(WrittenItem::Scan))
    }

    fn lacks_intensities(&self) -> bool {
        self.columns.intensities && !self.has_intensities
    }

    fn finish(self) -> io::Result<()> {
        self.out.finish()
    }
}

/// Writes the marks of the chosen sensor.
///
/// # Errors
///
/// Returns [`Kind::NoTopic`] if no marks were recorded.
pub(super) fn write_marks(
    conversion: &mut Conversion,
    columns: MarkColumns,
    mut out: OutputEncoder<impl Write>,
) -> Result<(), ConversionError> {
    let recording = conversion.recording;
    let mut lines = Vec::new();
    columns.write_header(&mut lines)?;
    let (mut samples, mut mark_count) = (0, 0);
    if recording.contents().form == Form::Mcap {
        let (mut reader, catalog) = recording.reader()?;
        while let Some(item) = reader.next().map_err(|error| recording.read_failure(&error))? {
            let Item::Record(record) = item else { continue };
            let Some((channel, header, payload)) = catalog.message(&record) else { continue };
            let mut marks = Marks::default();
            if channel.topic != Topic::Marks
                || recording.selected_sensor() != Some(&channel.sensor)
                || !marks.unpack(payload)
            {
                continue;
            }
            columns.write_rows(&mut lines, &header, &marks)?;
            out.write_all(&lines)?;
            lines.clear();
            samples += 1;
            mark_count += marks.marks().len() as u64;
            conversion.count(WrittenItem::Marks, Some(header.wall_ns))?;
        }
    }
    if samples == 0 {
        let path = recording.path().display();
        let message = format!("there are no recorded marks in {path}");
        let hint = format!(
            "`scanhub replay {path}` finds marks in the scans, and meanwhile `scanhub record SENSOR/marks` records them"
        );
        return Err(Failure::new(Kind::NoTopic, message, hint).into());
    }
    conversion.converted.marks = Some(mark_count);
    out.finish()?;
    Ok(())
}

/// Length in bytes after which a chunk ends.
const CHUNK_LEN: usize = 256 * 1024;

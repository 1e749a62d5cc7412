//! The tables of benches/README.md, from the lines that benches printed. A page goes in and comes out with new text between
//! its two markers. Refuses to measure, to read files, and to judge: a verdict was printed by who measured.

use serde_json::Value;

/// What stands between these two lines of the page is made here.
pub(crate) const BEGIN: &str =
    "<!-- From here on written by `cargo bench --bench report`, from benches/last. -->";
/// The other one.
pub(crate) const END: &str = "<!-- Until here. -->";

/// `page` with the tables of `files`, each the name of a bench and its lines.
pub(crate) fn page(page: &str, files: &[(&str, &str)]) -> Result<String, String> {
    let ends = page.split_once(BEGIN).and_then(|(before, rest)| Some((before, rest.split_once(END)?.1)));
    let (before, after) =
        ends.ok_or_else(|| format!("the page lacks a marker; write {BEGIN:?} and {END:?} into it"))?;
    let mut sections = String::new();
    for (bench, lines) in files {
        sections += &section(bench, lines)?;
    }
    Ok(format!("{before}{BEGIN}\n\n{sections}{END}{after}"))
}

/// What one bench printed, under the account of its run. Lines of other classes are for programs.
fn section(bench: &str, text: &str) -> Result<String, String> {
    let mut lines = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let value: Value = serde_json::from_str(line).map_err(|error| {
            format!("benches/last/{bench}.jsonl:{}: {error}; run `benches/run {bench}`", number + 1)
        })?;
        lines.push(value);
    }
    let of = |class: &str| lines.iter().filter(|line| line["class"] == class).collect::<Vec<_>>();
    let mut section = format!("### `{bench}`\n\n");
    for run in of("run") {
        section += &heading(run);
    }
    let figures = of("measurement");
    if !figures.is_empty() {
        section += &measurements(&figures);
    }
    let cells = of("cell");
    for table in appearing(&cells, "table") {
        let cells: Vec<&Value> = cells.iter().copied().filter(|cell| cell["table"] == table).collect();
        section += &matrix(table, &cells);
    }
    for picture in of("run").into_iter().flat_map(|run| run["pictures"].as_array().into_iter().flatten()) {
        let picture = text_of(picture);
        section += &format!("![{picture}](pictures/{picture})\n\n");
    }
    Ok(section)
}

/// Where and when it was measured.
fn heading(run: &Value) -> String {
    let [commit, date, machine, kernel] =
        ["commit", "date", "machine", "kernel"].map(|key| text_of(&run[key]));
    let others = run["others"]
        .as_f64()
        .map_or(String::new(), |cores| format!(", {} cores busy with other work", short(cores)));
    format!(
        "Commit {commit}, {date}: {machine}, {} cores, Linux {kernel}, load {} before{others}; {} s. `{}`\n\n",
        run["cores"],
        text_of(&run["load"]),
        run["seconds"],
        text_of(&run["command"])
    )
}

/// A row for each figure; columns that nobody fills are left out.
fn measurements(figures: &[&Value]) -> String {
    let filled = |key: &str| figures.iter().any(|figure| !figure[key].is_null());
    let is_wanted = |key: &&str| *key == "hub" || filled(key);
    let columns: Vec<&str> = ["hub", "floor", "ratio", "target"].into_iter().filter(is_wanted).collect();
    let mut rows = vec![["", "runs"].iter().chain(&columns).map(|head| head.to_string()).collect::<Vec<_>>()];
    for figure in figures {
        let mut row = vec![named(&figure["name"], &figure["unit"]), figure["runs"].to_string()];
        row.extend(columns.iter().map(|&column| match column {
            "target" => target(figure),
            _ => spread(&figure[column]),
        }));
        rows.push(row);
    }
    table(&rows)
}

fn target(figure: &Value) -> String {
    match (figure["target"].as_str(), figure["met"].as_bool()) {
        (Some(target), Some(true)) => format!("{target}: met"),
        (Some(target), Some(false)) => format!("{target}: **missed**"),
        (target, _) => target.unwrap_or_default().to_owned(),
    }
}

/// Rows and columns in order of appearance. A unit that a whole column shares stands at its head.
fn matrix(name: &str, cells: &[&Value]) -> String {
    let (rows, columns) = (appearing(cells, "row"), appearing(cells, "column"));
    let shared = |column: &str| {
        let mut units = cells.iter().filter(|cell| cell["column"] == column).map(|cell| &cell["unit"]);
        units.next().filter(|first| units.all(|unit| unit == *first))
    };
    let mut lines = vec![vec![String::new()]];
    lines[0].extend(columns.iter().map(|&column| match shared(column) {
        Some(unit) => named(&column.into(), unit),
        None => column.to_owned(),
    }));
    for row in rows {
        let mut line = vec![row.to_owned()];
        for column in &columns {
            let cell = cells.iter().find(|cell| cell["row"] == row && cell["column"] == **column);
            line.push(cell.map_or(String::new(), |cell| match spread(&cell["value"]) {
                value if value.is_empty() || shared(column).is_some() => value,
                value => named(&format!("{value} ").trim_end().into(), &cell["unit"]),
            }));
        }
        lines.push(line);
    }
    format!("**{name}**\n\n{}", table(&lines))
}

/// The first row is the head.
fn table(rows: &[Vec<String>]) -> String {
    let mut text = String::new();
    for (number, row) in rows.iter().enumerate() {
        let cells: String = row.iter().map(|cell| format!(" {} |", cell.replace('|', "\\|"))).collect();
        text += &format!("|{cells}\n");
        if number == 0 {
            text += &format!("|{}\n", "---|".repeat(row.len()));
        }
    }
    text + "\n"
}

/// Each value of `key` once, in order of appearance.
fn appearing<'a>(lines: &[&'a Value], key: &str) -> Vec<&'a str> {
    let mut found = Vec::new();
    for name in lines.iter().map(|line| text_of(&line[key])) {
        if !found.contains(&name) {
            found.push(name);
        }
    }
    found
}

fn named(name: &Value, unit: &Value) -> String {
    match (text_of(name), text_of(unit)) {
        (name, "" | "1") => name.to_owned(),
        (name, unit) => format!("{name}, {unit}"),
    }
}

fn text_of(value: &Value) -> &str {
    value.as_str().unwrap_or_default()
}

/// `median [least .. most]`; the median alone where all runs gave the same.
fn spread(value: &Value) -> String {
    match ["median", "least", "most"].map(|key| value[key].as_f64()) {
        [Some(median), Some(least), Some(most)] if least < most => {
            format!("{} [{} .. {}]", short(median), short(least), short(most))
        }
        [Some(median), ..] => short(median),
        _ => String::new(),
    }
}

/// Three digits that count; whole numbers as they are.
fn short(value: f64) -> String {
    let text = match value.abs() {
        size if size >= 100.0 || value == value.trunc() => format!("{value:.0}"),
        size if size >= 10.0 => format!("{value:.1}"),
        size if size >= 1.0 => format!("{value:.2}"),
        size if size >= 0.1 => format!("{value:.3}"),
        _ => format!("{value:.4}"),
    };
    let (sign, digits) = text.strip_prefix('-').map_or(("", text.as_str()), |digits| ("-", digits));
    if digits.len() <= 4 || digits.contains('.') {
        return text;
    }
    let groups = digits.as_bytes().rchunks(3).rev().map(String::from_utf8_lossy);
    format!("{sign}{}", groups.collect::<Vec<_>>().join(","))
}

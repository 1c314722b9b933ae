//! The results as Markdown tables that are also readable as plain text.

use super::claims::{Claim, END, Verdict};
use super::{Evidence, LAYOUTS, PARADIGMS, SOURCES, Source};
use crate::config::Learning;
use crate::report::table::markdown;
use crate::statistics;

/// Returns tables of the baselines without learning, next to evolution. They also show whether evolution beats random
/// search.
pub fn without_learning(results: Evidence<'_>) -> String {
    let last = results.arms.first().map_or(0, |arm| arm.config.learning.generations).min(END);
    let teams = results.arms.first().map_or(0, |arm| arm.config.learning.population) * (last + 1);
    let mut sources = vec!["POIs at generation ".to_string() + &last.to_string(), "of".into()];
    sources.extend(SOURCES.map(|source| match source {
        Source::Random => format!("best of {teams} random teams"),
        _ => source.to_string(),
    }));
    let mut rows = vec![sources];
    let mut races =
        vec![vec!["Best team so far, evolution less random".to_string(), "G".into(), "D".into(), "Df".into()]];
    let mut solved = Vec::new();
    for (layout, name) in LAYOUTS.iter().enumerate() {
        for paradigm in PARADIGMS {
            let name = format!("{}, {paradigm}", name.name);
            let course = |source| results.course(layout, paradigm, source);
            let pois = course(SOURCES[0]).map_or(0, |course| course.pois);
            let mut row = vec![name.clone(), pois.to_string()];
            row.extend(SOURCES.map(|source| {
                let Some((course, observed)) = course(source).and_then(|c| Some((c, c.observed(last)?))) else {
                    return String::new();
                };
                match statistics::mean(&observed, 1.0).map(|mean| mean.within(0.0, pois as f64)) {
                    Some(mean) if !course.certain => format!("{:.2} [{:.2}, {:.2}]", mean.value, mean.low, mean.high),
                    _ => observed.first().map_or(String::new(), |pois| format!("{pois:.2}")),
                }
            }));
            rows.push(row);
            let random = course(Source::Random).and_then(|course| course.observed_by(last)).unwrap_or_default();
            let mut race = vec![name.clone()];
            race.extend(SOURCES[2..].iter().map(|&source| {
                let evolved = course(source).and_then(|course| course.observed_by(last)).unwrap_or_default();
                let lead: Vec<f64> = evolved.iter().zip(&random).map(|(evolved, random)| evolved - random).collect();
                let within = |mean: statistics::Estimate| mean.within(-(pois as f64), pois as f64);
                let Some(mean) = statistics::mean(&lead, 1.0).map(within) else { return "open: takes 2 trials".into() };
                let word = match mean {
                    _ if mean.low > 0.0 => "ahead",
                    _ if mean.high < 0.0 => "behind",
                    _ => "not decided",
                };
                format!("{word}: {:+.2} [{:.2}, {:.2}]", mean.value, mean.low, mean.high).replace('-', "−")
            }));
            races.push(race);
            let straight = course(Source::Straight).and_then(|course| course.observed(last)).unwrap_or_default();
            if !straight.is_empty() && straight.iter().all(|&observed| observed >= pois as f64) {
                solved.push(name);
            }
        }
    }
    let meaning = if solved.is_empty() {
        "A team whose weights are all zero goes straight ahead at half speed; nowhere does it observe every POI.".into()
    } else {
        format!(
            "A team whose weights are all zero goes straight ahead at half speed. Untrained, it observes every POI in: {}. \
             There the layout gives the task away, and that evolved teams observe every POI is no evidence of how well they \
             learn.",
            solved.join("; ")
        )
    };
    format!("{meaning}\n\n{}\n{}", markdown(&rows), markdown(&races))
}

/// Returns the verdicts on all claims without figures, for a terminal and the first page.
pub fn verdicts(claims: &[Claim]) -> String {
    let mut rows = vec![[vec!["Layout".to_string(), "The paper says".into()], sources()].concat()];
    for claim in claims {
        let cells = cells(claim, |verdict, _| verdict.to_string());
        rows.push([vec![claim.layout.to_string(), claim.words.to_string()], cells].concat());
    }
    markdown(&rows)
}

/// Returns all claims with their measures and figures.
pub fn full(claims: &[Claim]) -> String {
    let head = ["Layout", "Where", "The paper says", "Measured here"].map(String::from).to_vec();
    let mut rows = vec![[head, sources()].concat()];
    for claim in claims {
        let Claim { layout, place, words, measure, .. } = *claim;
        let cells = cells(claim, |verdict, measured| format!("{verdict}: {measured}"));
        rows.push([[layout, place, words, measure].map(String::from).to_vec(), cells].concat());
    }
    markdown(&rows)
}

fn sources() -> Vec<String> {
    SOURCES.map(|source| source.to_string()).to_vec()
}

/// Returns a claim's cells by source. A cell of a comparison names what is compared.
fn cells(claim: &Claim, say: impl Fn(Verdict, &str) -> String) -> Vec<String> {
    let cell = |(column, source): (usize, Source)| {
        let Some(found) = claim.findings.iter().find(|found| found.column == column) else { return "·".into() };
        let said = say(found.verdict, &found.measured);
        if found.of == source.to_string() { said } else { format!("({}) {said}", found.of) }
    };
    SOURCES.into_iter().enumerate().map(cell).collect()
}

/// Counts the verdicts by kind.
pub fn count(claims: &[Claim]) -> String {
    let all: Vec<Verdict> = claims.iter().flat_map(Claim::on_evolution).map(|found| found.verdict).collect();
    let count = |verdict| all.iter().filter(|&&other| other == verdict).count();
    let [yes, no, undecided, open] = [Verdict::Yes, Verdict::No, Verdict::Undecided, Verdict::Open].map(count);
    let open = if open > 0 { format!(", {open} open (too few generations or trials)") } else { String::new() };
    let (claims, verdicts) = (claims.len(), all.len());
    format!("{verdicts} verdicts on {claims} claims: {yes} yes, {no} no, {undecided} not decided{open}.")
}

/// Returns the heading: number of trials, generations and seed.
pub fn heading(learning: &Learning, claims: &[Claim]) -> String {
    let Learning { trials, generations, seed, .. } = learning;
    format!("{} {trials} trials, {generations} generations, seed {seed}.", count(claims))
}

/// Returns `claims.md`, with the results without learning first.
pub fn page(without_learning: &str, heading: &str, full: &str) -> String {
    format!(
        "# What the paper says, measured\n\n## Before anything is learned\n\n{without_learning}\n{RACE}\n\n\
         ## The paper's claims\n\n{heading}\n\n{LEGEND}\n\n{full}"
    )
}

/// Explains the table of baselines.
pub const RACE: &str = "\
Means over trials of each generation's best team, in POIs, with 95 % intervals. Random teams are as many as evolution
evaluated, drawn as its first generation is, and their best so far is kept; in the second table evolution's best so far
is kept too, since it would not be a fair race otherwise. Trials with one seed are pairs, whatever the arm: the same
starts, the same luck in every draw, and, where the sizes agree, the same first populations; differences are of pairs.";

/// Explains the table of claims.
pub const LEGEND: &str = "\
*yes*: the 95 % interval, in brackets, lies within what the words allow; *no*: it lies outside; *not decided*: it holds
the threshold, and more trials might tell; *open*: too few generations or trials. Means and differences by Student's t,
over pairs where arms are compared; shares by Clopper and Pearson. Where the paper gives no number: *almost never* is
under 1 trial in 10, *some of the time* 1 in 10 to 9 in 10; *all* is refuted by one trial that does not, and holds where
the interval of those that do starts at 9 in 10; *similar*, *comparable* and *slight* are differences under a tenth of
the POIs. The columns *straight ahead* and *random teams* hold the same measure for what needs no learning, and are not
counted: a *yes* there says that the claim speaks of the task rather than of what was learned. Alone, Df is D. Every
interval stands for itself: of so many, a few miss what they estimate by chance.";

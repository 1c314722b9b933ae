//! The results as Markdown tables that are also readable as plain text.

use super::claims::{Claim, END, Verdict};
use super::{BASELINES, Evidence, LAYOUTS, PARADIGMS, SOURCES, Source};
use flotilla::config::Learning;
use flotilla::statistics::{self, Average};
use flotilla_app::report::table::markdown;

/// Returns tables of the baselines without learning, next to evolution. They also show whether evolution beats random
/// search.
pub fn without_learning(results: Evidence<'_>) -> String {
    let last = results.arms.first().map_or(0, |arm| arm.config.learning.generations).min(END);
    let each = results.arms.first().map_or(0, |arm| arm.config.learning.team_count());
    let teams = each * (last + 1);
    let mut sources = vec!["POIs at generation ".to_string() + &last.to_string(), "of".into()];
    sources.extend(SOURCES.map(|source| match source {
        Source::Constant => "best constant speed".into(),
        Source::Actions | Source::Random | Source::Shared => format!("best of {teams} {source}"),
        Source::OpenLoop | Source::HillClimbing => format!("{source}, {teams} teams"),
        Source::Evolved(_) => format!("{source}: champion (best of {each} teams)"),
    }));
    let mut rows = vec![sources];
    let mut races = vec![vec![
        "Best team so far, evolution less shared random networks".to_string(),
        "G".into(),
        "D".into(),
        "Df".into(),
    ]];
    let mut solved = Vec::new();
    for (layout, name) in LAYOUTS.iter().enumerate() {
        for paradigm in PARADIGMS {
            let name = format!("{}, {paradigm}", name.name);
            let curves = |source| results.curves(layout, paradigm, source);
            let pois = curves(SOURCES[0]).map_or(0, |curves| curves.pois);
            let mut row = vec![name.clone(), pois.to_string()];
            row.extend(SOURCES.map(|source| {
                let Some((curves, observed)) = curves(source).and_then(|c| Some((c, c.observed(last)?))) else {
                    return String::new();
                };
                let best = curves.of_best().observed(last).filter(|_| matches!(source, Source::Evolved(_)));
                let best = best.map(|best| format!(" ({:.2})", best.iter().collect::<Average>().mean()));
                let champion = match statistics::bounded(&observed.iter().collect(), [0.0, pois as f64]) {
                    Some(mean) if !curves.certain => format!("{:.2} [{:.2}, {:.2}]", mean.value, mean.low, mean.high),
                    _ => observed.first().map_or(String::new(), |pois| format!("{pois:.2}")),
                };
                champion + &best.unwrap_or_default()
            }));
            rows.push(row);
            let random =
                curves(Source::Shared).and_then(|curves| curves.of_best().observed_by(last)).unwrap_or_default();
            let mut race = vec![name.clone()];
            race.extend(SOURCES[BASELINES..].iter().map(|&source| {
                let evolved = curves(source).and_then(|curves| curves.of_best().observed_by(last)).unwrap_or_default();
                let lead: Vec<f64> = evolved.iter().zip(&random).map(|(evolved, random)| evolved - random).collect();
                let Some(mean) = statistics::paired(&lead.iter().collect(), pois as f64) else {
                    return "open: takes 2 trials".into();
                };
                let word = match mean {
                    _ if mean.low > 0.0 => "ahead",
                    _ if mean.high < 0.0 => "behind",
                    _ => "not decided",
                };
                format!("{word}: {:+.2} [{:.2}, {:.2}]", mean.value, mean.low, mean.high).replace('-', "−")
            }));
            races.push(race);
            let constant = curves(Source::Constant).and_then(|curves| curves.observed(last)).unwrap_or_default();
            if !constant.is_empty() && constant.iter().all(|&observed| observed >= pois as f64) {
                solved.push(name);
            }
        }
    }
    let meaning = if solved.is_empty() {
        "No constant speed, straight ahead, observes every POI anywhere.".into()
    } else {
        let there = match solved.len() == LAYOUTS.len() * PARADIGMS.len() {
            true => "of every layout in both paradigms".into(),
            false => format!("in: {}", solved.join("; ")),
        };
        format!(
            "A constant speed, straight ahead, observes every POI {there}. Such a team senses nothing, so teams that observe \
             every POI there need not have learned to sense."
        )
    };
    format!("{meaning}\n\n{}\n{}", markdown(&rows), markdown(&races))
}

/// Returns the verdicts on all claims without figures, for a terminal and the first page.
pub fn verdicts(claims: &[Claim]) -> String {
    let mut rows =
        vec![[vec!["Layout".to_string(), "The paper says".into(), "all fitnesses".into()], sources()].concat()];
    for claim in claims {
        let cells = cells(claim, |verdict, _| verdict.to_string());
        rows.push([vec![layout(claim), claim.words.to_string(), claim.verdict().to_string()], cells].concat());
    }
    markdown(&rows)
}

/// Returns all claims with their measures and figures.
pub fn full(claims: &[Claim]) -> String {
    let head = ["Layout", "Where", "The paper says", "Measured here"].map(String::from).to_vec();
    let mut rows = vec![[head, sources()].concat()];
    for claim in claims {
        let Claim { place, words, measure, .. } = *claim;
        let cells = cells(claim, |verdict, measured| format!("{verdict}: {measured}"));
        rows.push([vec![layout(claim)], [place, words, measure].map(String::from).to_vec(), cells].concat());
    }
    markdown(&rows)
}

/// Returns a claim's layout, marked if the experiment is ours.
fn layout(claim: &Claim) -> String {
    claim.layout.to_string() + if claim.exploratory { " †" } else { "" }
}

fn sources() -> Vec<String> {
    SOURCES.map(|source| source.to_string()).to_vec()
}

/// Returns a claim's cells by source. A cell of a comparison names what is compared.
fn cells(claim: &Claim, say: impl Fn(Verdict, &str) -> String) -> Vec<String> {
    let cell = |(column, source): (usize, Source)| {
        let Some(found) = claim.findings.iter().find(|found| found.column == column) else { return "·".into() };
        let text = say(found.verdict, &found.measured);
        if found.of == source.to_string() { text } else { format!("({}) {text}", found.of) }
    };
    SOURCES.into_iter().enumerate().map(cell).collect()
}

/// Counts the claims by verdict, those of the paper's own experiments first.
pub fn count(claims: &[Claim]) -> String {
    let of = |exploratory: bool| {
        let all: Vec<Verdict> =
            claims.iter().filter(|claim| claim.exploratory == exploratory).map(Claim::verdict).collect();
        let count = |verdict| all.iter().filter(|&&other| other == verdict).count();
        let [yes, no, undecided, open] = [Verdict::Yes, Verdict::No, Verdict::Undecided, Verdict::Open].map(count);
        let open = if open > 0 { format!(", {open} open (too few generations or trials)") } else { String::new() };
        (all.len(), format!("{yes} yes, {no} no, {undecided} not decided{open}"))
    };
    let ((paper, verdicts), (ours, exploratory)) = (of(false), of(true));
    format!("{paper} claims on the paper's experiments: {verdicts}. {ours} exploratory claims (†): {exploratory}.")
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
pub(crate) const RACE: &str = "\
Means over trials in POIs, with 95 % intervals. The champion is the team of every population's best policy. In parentheses
is the best of a generation's teams, a maximum that grows with their number. Each baseline but the constant speed plays as many
teams as evolution, and its best so far is kept. Hill climbing mutates a whole team, of networks or of four open-loop actions per
leader. The second table keeps evolution's best so far, too.
Trials with one seed are pairs: they have the same starts and, where the sizes agree, the same first populations.
Differences are over pairs.";

/// Explains the table of claims.
pub(crate) const LEGEND: &str = "\
*yes*: the interval lies within what the words allow. *no*: it lies outside. *not decided*: it contains the threshold.
*open*: too few generations or trials. Brackets are the 95 % intervals of `flotilla compare`, and for a
count of trials the exact interval of Clopper and Pearson. p is the smallest alpha at which the interval decides, corrected by
Holm's method for all verdicts on evolved teams at once; a verdict needs p of at most 0.05. A claim holds if it holds under every fitness, and fails if it
fails under one. Curves are judged by averages over trials, since the paper's curves are averages. If the paper gives no
number, *almost never* is under 1 trial in 10 and *some of the time* is 1 in 10 to 9 in 10. *All POIs* is an average of at
least nine tenths of them, and *similar*, *comparable* and *slight* are differences under a tenth. The baselines' columns
have the same measures, uncorrected and not counted. A *yes* there says that the claim is about the task rather than about
learning. Without followers, Df is D. † marks experiments of ours for sentences that describe none.";

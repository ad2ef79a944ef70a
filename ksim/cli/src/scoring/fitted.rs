//! The dataset read, normalized and searchable.

use anyhow::{Context as _, Result, bail};
use ksim::{KSim, Prepared, Reference, Search};
use ksim_index::SavedIndex;

use super::{Inputs, Job};
use crate::centers::Centers;
use crate::context::Context;
use crate::document::{DatasetPart, Parameters, SearchPart, fingerprint};
use crate::indexed::{self, Request};
use crate::load::{self, StepNumbers};
use crate::settings::Settings;

/// A fitted reference and what is known about it.
pub(super) struct Fitted {
    pub(super) ksim: KSim,
    /// An exact search over the same reference, if the approximation error is wanted.
    pub(super) exact: Option<KSim>,
    /// The index the reference lies in, which bounds the memory of a large one while it lives.
    _saved: Option<SavedIndex>,
    pub(super) steps: StepNumbers,
    pub(super) dataset: DatasetPart,
    pub(super) parameters: Parameters,
    pub(super) search: SearchPart,
    pub(super) fingerprint: String,
}

/// A normalized reference, and what is known about it.
struct Loaded {
    reference: Reference,
    prepared: Prepared,
    fingerprint: String,
    steps: StepNumbers,
    saved: Option<SavedIndex>,
}

/// Takes the reference from the index, or reads and normalizes the dataset.
fn load_reference(
    inputs: &Inputs,
    centers: Option<&Centers>,
    job: &Job,
    context: &Context,
) -> Result<Loaded> {
    let (source, columns) = (&*inputs.dataset, &inputs.columns);
    if let Some(path) = &job.index {
        let request = Request {
            source,
            options: &job.dataset_options,
            columns,
            settings: &job.settings,
            centers,
        };
        let indexed = indexed::open(path, &request, context)?;
        return Ok(Loaded {
            reference: indexed.reference,
            prepared: indexed.prepared,
            fingerprint: indexed.saved.about().dataset.fingerprint.clone(),
            steps: indexed.numbers,
            saved: Some(indexed.saved),
        });
    }
    let (data, steps) = load::dataset(source, columns, context)?.into_parts();
    Ok(Loaded {
        fingerprint: data.fingerprint(),
        reference: Reference::new(data)?,
        prepared: Prepared::default(),
        steps,
        saved: None,
    })
}

/// Builds the search over the dataset.
pub(super) fn fit(inputs: &Inputs, job: &Job, context: &Context) -> Result<Fitted> {
    let settings = &job.settings;
    let info = inputs.dataset.info();
    let columns = &inputs.columns;
    let centers = read_centers(settings, columns.indices.len())?;
    let loaded = load_reference(inputs, centers.as_ref(), job, context)?;
    let reference = loaded.reference;
    let dataset = DatasetPart {
        n_episodes: reference.episodes().len(),
        n_steps: reference.states().n_rows(),
        fingerprint: loaded.fingerprint,
        ..DatasetPart::new(&inputs.dataset_name, info)
    };
    let mut parameters = Parameters::new(settings, columns, reference.actions().n_features());
    let working = match (settings.search, &centers, &loaded.prepared.clusters) {
        (Search::Clusters, None, None) => "fitting the clusters",
        _ => "building the search",
    };
    let progress = context.spinner(working.to_owned());
    let given = centers.as_ref().map(|centers| centers.values.clone());
    let mut params = settings.params(given);
    if let Some(n_steps) = n_steps(inputs)? {
        params = params.n_queries(n_steps);
    }
    let ksim = params
        .fit_prepared(reference, loaded.prepared)
        .with_context(|| info.path.display().to_string())?;
    let exact = match settings.approximation_error {
        true => {
            let rounded = loaded.saved.as_ref().map(SavedIndex::rounded_rows);
            let prepared = Prepared {
                clusters: None,
                rounded: rounded.transpose()?.flatten(),
            };
            Some(ksim.with_prepared(Search::Auto, prepared)?)
        }
        false => None,
    };
    drop(progress);
    let mut search = SearchPart::new(settings, centers.as_ref(), &ksim);
    search.index = job.index.as_ref().map(|path| path.display().to_string());
    parameters.n_clusters = search.clusters.as_ref().map(|clusters| clusters.n_clusters);
    let fingerprint = fingerprint(&dataset, &parameters, &search, centers.as_ref());
    Ok(Fitted {
        ksim,
        exact,
        _saved: loaded.saved,
        steps: loaded.steps,
        dataset,
        parameters,
        search,
        fingerprint,
    })
}

/// Steps of all rollouts, where their files say; of no rollouts yet, nothing is known.
fn n_steps(inputs: &Inputs) -> Result<Option<usize>> {
    let counts = inputs
        .rollouts
        .iter()
        .map(|file| file.source.info().n_steps);
    let n_steps = counts.sum::<Option<u64>>().filter(|n_steps| *n_steps > 0);
    Ok(n_steps.map(usize::try_from).transpose()?)
}

fn read_centers(settings: &Settings, width: usize) -> Result<Option<Centers>> {
    let Some(file) = &settings.centers else {
        return Ok(None);
    };
    let centers = file.read(width)?;
    let found = centers.values.len() / width;
    if settings.n_clusters_given && found != settings.n_clusters {
        bail!(
            "{}: tensor \"{}\" holds {found} centers, expected {} as --n-clusters says",
            file.path.display(),
            centers.tensor,
            settings.n_clusters
        );
    }
    Ok(Some(centers))
}

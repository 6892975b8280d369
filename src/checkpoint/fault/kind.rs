//! The kinds of fault: one list with the name of each kind, the stage that produces it, and the keys of its details.

use std::fmt;

use serde::{Serialize, Serializer};
use serde_json::Value;

use super::detail::{DeclaredKey, declared_keys};

/// The stage that produces faults of a kind.
#[cfg(feature = "internals")]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FaultSource {
    /// The readers in `checkpoint`, from one file.
    Reader,
    /// The comparisons in `check`, from several files or from knowledge.
    Comparison,
}

/// Declares [`FaultKind`] from lines `Variant = "kebab-case-name" { key: Type }`, grouped by the stage that produces them.
/// The keys are those of the details, in the form of [`declared_keys`].
macro_rules! fault_kinds {
    ($($source:ident { $($variant:ident = $name:literal { $($keys:tt)* },)* })*) => {
        /// A kind of fault. Rules in `rules/checks/` select faults by [`FaultKind::name`].
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[cfg_attr(test, derive(schemars::JsonSchema), schemars(rename_all = "kebab-case"))]
        #[non_exhaustive]
        pub enum FaultKind {
            $($(
                #[doc = concat!("`", $name, "`")]
                $variant,
            )*)*
        }

        impl FaultKind {
            /// Every kind: those of the readers first, each group sorted by name.
            pub const ALL: &[Self] = &[$($(Self::$variant,)*)*];

            /// The name in rules and reports: `header-not-json`.
            #[must_use]
            pub const fn name(self) -> &'static str {
                match self {
                    $($(Self::$variant => $name,)*)*
                }
            }

            /// The kind of this name; `None` for an unknown name.
            #[must_use]
            pub fn from_name(name: &str) -> Option<Self> {
                match name {
                    $($($name => Some(Self::$variant),)*)*
                    _ => None,
                }
            }

            /// The keys of the details of such a fault.
            pub(super) const fn declared(self) -> &'static [DeclaredKey] {
                match self {
                    $($(Self::$variant => declared_keys! { $($keys)* },)*)*
                }
            }

            /// The stage that produces faults of this kind.
            #[cfg(feature = "internals")]
            #[must_use]
            pub const fn source(self) -> FaultSource {
                match self {
                    $($(Self::$variant => FaultSource::$source,)*)*
                }
            }
        }
    };
}

fault_kinds! {
    Reader {
        AppendedSection = "appended-section" { section: Text },
        ByteOrderMark = "byte-order-mark" {},
        CheckpointTooLarge = "checkpoint-too-large" { count: Integer },
        CommentInJson = "comment-in-json" {},
        ContentEdited = "content-edited" { algorithm: Text, source: Text, stated: Text, found: Text },
        ContentHashDiffers = "content-hash-differs" { algorithm: Text, source: Text, stated: Text, found: Text },
        ContentsUnread = "contents-unread" { reason: Text },
        DanglingSymlink = "dangling-symlink" { target: Text },
        DataHole = "data-hole" { begin: Integer, end: Integer, bytes: Integer },
        DuplicateHeaderKey = "duplicate-header-key" { key: Text },
        DuplicateIndexKey = "duplicate-index-key" { key: Text, equal: Flag },
        DuplicateJsonKey = "duplicate-json-key" { key: Text, equal: Flag },
        EmptyDocument = "empty-document" { size: Integer },
        EmptyFile = "empty-file" {},
        EntryMalformed = "entry-malformed" { reason: Text },
        FileTooLarge = "file-too-large" { size: Integer, cap: Integer },
        FileTooShort = "file-too-short" { file_len: Integer },
        ForeignJournal = "foreign-journal" { reason: Text },
        HeaderLengthOutOfRange = "header-length-out-of-range" { stated: Integer, file_len: Integer, big_endian: Flag },
        HeaderNotJson = "header-not-json" { reason: Text, offset: Integer },
        HeaderNotUtf8 = "header-not-utf8" { offset: Integer },
        HeaderPaddingNotSpaces = "header-padding-not-spaces" { what: Text },
        HeaderTooDeep = "header-too-deep" { offset: Integer },
        HeaderTooLarge = "header-too-large" { stated: Integer, cap: Integer },
        HtmlInstead = "html-instead" { looks_like: Text },
        HugeNumber = "huge-number" { literal: Text, digits: Integer },
        IndexMetadataMissing = "index-metadata-missing" { present: Flag },
        IndexUnsafePath = "index-unsafe-path" { path: Text },
        InvalidUtf8 = "invalid-utf8" { offset: Integer, byte?: Text },
        JsonSyntax = "json-syntax" { reason: Text, found: Text },
        JsonTooDeep = "json-too-deep" { cap: Integer },
        JsonTooManyValues = "json-too-many-values" { cap: Integer },
        LfsPointer = "lfs-pointer" { oid: Text, size: Integer, tracked?: Flag },
        LinkNotFollowed = "link-not-followed" { target: Text },
        LoneSurrogate = "lone-surrogate" {},
        MergeConflictMarker = "merge-conflict-marker" { marker: Text },
        MetadataNotStrings = "metadata-not-strings" { key?: Text, scalar?: Flag },
        MetadataNull = "metadata-null" {},
        MissingComma = "missing-comma" {},
        NoFormatMetadata = "no-format-metadata" { metadata: Flag, format: OrNull(&Text) },
        NonFiniteNumber = "non-finite-number" { literal: Text },
        NonFiniteWeights = "non-finite-weights" {
            nan: Integer, infinite: Integer, elements: Integer, first: Integer, used: Flag,
        },
        NotARegularFile = "not-a-regular-file" { what: Text },
        NotAnObject = "not-an-object" { found: Text },
        NotSafetensors = "not-safetensors" { what: Text },
        NulBytes = "nul-bytes" { count: Integer, all: Flag },
        NotATorchFile = "not-a-torch-file" { what: Text },
        OddTensorName = "odd-tensor-name" { reason: Text, bytes: Integer },
        OffsetsOutOfOrder = "offsets-out-of-order" { begin: Integer, end: Integer },
        PartialDownload = "partial-download" { of: Text },
        PickleCutShort = "pickle-cut-short" { what: Text, missing: OrNull(&Integer), file_len: Integer, zip: Flag },
        PickleImportsSkipped = "pickle-imports-skipped" { reason: Text, offset: Integer },
        PickleImportsUnread = "pickle-imports-unread" { reason: Text, offset: Integer },
        PickleMalformed = "pickle-malformed" { reason: Text, offset: Integer },
        PickleNested = "pickle-nested" { key: Text, tensors: Integer, first: Text, keys: List(&Text) },
        PickleNotAStateDict = "pickle-not-a-state-dict" { what: Text },
        PickleStorageWrong = "pickle-storage-wrong" { storage: Text, claimed: Integer, stored: OrNull(&Integer) },
        PickleTensorOutOfRange = "pickle-tensor-out-of-range" {
            storage: Text, shape: List(&Integer), offset: Integer, bytes: Integer,
        },
        PickleTooLarge = "pickle-too-large" { what: Text },
        PythonSyntax = "python-syntax" {},
        PythonTooComplex = "python-too-complex" {},
        RepairInterrupted = "repair-interrupted" {},
        ShapeByteMismatch = "shape-byte-mismatch" {
            dtype: Text, shape: List(&Integer), computed: Integer, stored: Integer,
        },
        ShapeOverflow = "shape-overflow" { dtype: Text, shape: List(&Integer) },
        ShardTruncated = "shard-truncated" { needed: Integer, file_len: Integer, missing: Integer, tensors: Integer },
        SingleQuotedString = "single-quoted-string" {},
        SubByteMisaligned = "sub-byte-misaligned" { dtype: Text, shape: List(&Integer), bits: Integer },
        SymlinkLoop = "symlink-loop" {},
        SymlinkOutside = "symlink-outside" { target: Text },
        TensorsOverlap = "tensors-overlap" { begin: Integer, bytes: Integer },
        TotalSizeMalformed = "total-size-malformed" { found: Text },
        TrailingBytes = "trailing-bytes" { count: Integer, looks_like?: Text },
        TrailingComma = "trailing-comma" {},
        TrailingContent = "trailing-content" { what: Text, bytes: Integer },
        UnknownDtype = "unknown-dtype" { dtype: Text },
        UnreadableFile = "unreadable-file" { reason: Text },
        VocabularyMalformed = "vocabulary-malformed" { reason: Text },
        WeightMapMalformed = "weight-map-malformed" { found: Text },
        WeightMapMissing = "weight-map-missing" {},
        WrongEncoding = "wrong-encoding" { encoding: Text },
        ZeroTail = "zero-tail" { tensors: Integer, bytes: Integer, partly: Flag },
    }
    Comparison {
        AdapterBaseDiffers = "adapter-base-differs" {
            module: Text, stored: List(&Integer), base: List(&Integer), rows: Flag,
        },
        AdapterBaseIsAPath = "adapter-base-is-a-path" { base: Text, of_card?: Text },
        AdapterBesideModel = "adapter-beside-model" { base: Text, weights: Flag },
        AdapterConfigKeyGone = "adapter-config-key-gone" { keys: List(&Text), until: Text, version: Text },
        AdapterConfigKeyUnknown = "adapter-config-key-unknown" {
            key: Text, count: Integer, keys: List(&Text), version: Text, raises: Flag, asked: Flag, class: Text,
            set: List(&Text), all_idle: Flag, drops: List(&Text), needs?: Text,
        },
        AdapterDoraDisagrees = "adapter-dora-disagrees" { module: Text, stored: Flag, alike: Flag },
        AdapterKeyUnread = "adapter-key-unread" {
            tensor: Text, reason: Text, named: Flag, converted: Flag,
        },
        AdapterMagnitudeMisshapen = "adapter-magnitude-misshapen" {
            module: Text, stored: List(&Integer), expected: Integer,
        },
        AdapterModulesBare = "adapter-modules-bare" { module: Text, count: Integer, class: Text, base: Text },
        AdapterModuleNotSaved = "adapter-module-not-saved" { modules: List(&Text) },
        AdapterModuleUntargeted = "adapter-module-untargeted" { module: Text, count: Integer, targets?: List(&Text) },
        AdapterNamesCut = "adapter-names-cut" { tensor: Text, new: Text, count: Integer, names: List(&List(&Text)) },
        AdapterOfAModel = "adapter-of-a-model" { base: Text, rank: Any, found?: Text },
        AdapterOfAnotherFormat = "adapter-of-another-format" { format: Text, count: Integer, shard: Text },
        AdapterPairIncomplete = "adapter-pair-incomplete" { module: Text, lacks: Text },
        AdapterRankDisagrees = "adapter-rank-disagrees" {
            module: Text, a: List(&Integer), b: List(&Integer), rank: OrNull(&Integer), experts?: Flag,
            trained?: Integer,
        },
        AdapterRankUnusable = "adapter-rank-unusable" { rank: Any },
        AdapterTargetsAbsent = "adapter-targets-absent" { targets: Text, class: Text, base: Text },
        AdapterTensorsEmpty = "adapter-tensors-empty" { count: Integer, all: Flag },
        AdapterTypeMissing = "adapter-type-missing" {},
        AdapterTypeUnchecked = "adapter-type-unchecked" { peft_type: Text },
        AdapterTypeUnknown = "adapter-type-unknown" { peft_type: Text, version: Text, similar?: Text },
        AdapterUnplaced = "adapter-unplaced" {
            tensor: Text, count: Integer, total: Integer, class: Text, base: Text, new?: Text, names?: List(&List(&Text)),
        },
        AdapterValueRefused = "adapter-value-refused" { key: Text, value: Any, raises: Text, default_value?: Any },
        AdapterWeightsMissing = "adapter-weights-missing" {},
        AdapterWithoutMatrices = "adapter-without-matrices" { tensors: Integer },
        AddedTokenMoved = "added-token-moved" { token: Text, stated: Integer, given: Integer, count: Integer },
        AddedTokensDisagree = "added-tokens-disagree" { token: Text, id: Integer, decoder_id: Integer },
        AddedTokensDropped = "added-tokens-dropped" { token: Text, count: Integer, class: Text },
        AliasMissesImport = "alias-misses-import" { module: Text, imports: List(&Text), target: Text },
        AllShardsAbsent = "all-shards-absent" { count: Integer, tensors: Integer, first: Text },
        AutoMapClassMissing = "auto-map-class-missing" { target: Text, key: Text, module: Text, class: Text },
        AutoMapMalformed = "auto-map-malformed" { target: Text, key: Text, dots: Integer },
        AutoMapModuleMissing = "auto-map-module-missing" {
            target: Text, key: Text, module: Text, importers: List(&Text), origin?: Text, native?: Flag,
        },
        AutoMapNestedMissing = "auto-map-nested-missing" { target: Text, key: Text, module: Text, origin?: Text },
        AutoMapRemote = "auto-map-remote" { target: Text, key: Text, repository: Text },
        AutoMapUnsafePath = "auto-map-unsafe-path" { target: Text, key: Text, repository?: Text },
        BeginTwice = "begin-twice" { token: Text },
        CardBaseIsAPath = "card-base-is-a-path" { base: Text },
        ClassNameUnknown = "class-name-unknown" {
            key: Text, auto: Text, class: Text, versions: List(&Text), of_code: Flag, known: Flag, right?: Text,
        },
        ClassOfWholeModel = "class-of-whole-model" { class: Text, model_type: Text, own: Text },
        ConfigIncomputable = "config-incomputable" {
            architecture: Text, raises?: Text, loader?: Text, reason?: Text, nested?: Flag,
        },
        ConfigOutvoted = "config-outvoted" {
            key: Text, given: Flag, said: Any, voted: Any, agree: Integer, total: Integer, names: List(&Text),
            raising: List(&Text), mismatched?: Text,
        },
        DirectoryNameWithDot = "directory-name-with-dot" {
            package: Text, directory: Text, module: Text, imported: Text,
        },
        DirectoryRecognised = "directory-recognised" {
            is: Text, signs: List(&Text), command?: Text, has_config?: Flag, program?: Text,
        },
        EightBitFloats = "eight-bit-floats" { count: Integer, dtype: Text, kept: List(&Text) },
        EmptyTensors = "empty-tensors" { count: Integer, names: List(&Text), under?: Text, unmet?: Flag },
        GenerationValueRefused = "generation-value-refused" {
            key: Text, value: Any, because: Text, raises: Text, similar?: Text, generates: Flag,
        },
        IndexEntryNotAShard = "index-entry-not-a-shard" { named: Text, tensors: Integer, pickle: Flag },
        IndexKeyNowhere = "index-key-nowhere" { said: Text },
        IndexMissing = "index-missing" { shards: Integer, index: Text },
        IndexNamesOtherShard = "index-names-other-shard" { said: Text, held: Text },
        IntegerWeights = "integer-weights" { count: Integer, dtype: Text, raises: Text },
        LayerLacksTensor = "layer-lacks-tensor" { layer: Text, siblings: Integer, names: List(&Text), lacks: Integer },
        LfsSizesBelowTotal = "lfs-sizes-below-total" { stated: Integer, sum: Integer, count: Integer },
        LfsSizesNotOfClass = "lfs-sizes-not-of-class" { bytes: Integer, parameters: Integer, class: Text },
        LoadRaises = "load-raises" { reason: Text, under?: Text },
        LoadsDiffer = "loads-differ" {
            loads: Text, loader: Text, count?: Integer, missing?: List(&Text), reason?: Text,
            mismatched?: List(&Text), raises?: Text,
        },
        MergesArePairs = "merges-are-pairs" {},
        MismatchedTensor = "mismatched-tensor" {
            tensor: Text, stored: List(&Integer), expected: List(&Integer), under?: Text, unmet?: Flag,
        },
        MissingTensors = "missing-tensors" { count: Integer, names: List(&Text), under?: Text },
        ModelTypeMissing = "model-type-missing" { directory: Text, class?: Text, of_class?: Text, guess?: Text },
        ModelTypeUnknown = "model-type-unknown" {
            model_type: Any, versions: List(&Text), part?: Flag, similar?: Text, class?: Text, of_class?: Text,
        },
        ModuleImportGone = "module-import-gone" {
            module: Text, from: Text, names: List(&Text), whole: Flag, versions: List(&Text),
        },
        ModuleNeedsPackage = "module-needs-package" { packages: List(&Text), modules: List(&Text) },
        NamesMoved = "names-moved" {
            from: Text, to: Text, count: Integer, adapter?: Flag, prefixes: List(&List(&Text)), names: List(&Text),
        },
        NamesWrapped = "names-wrapped" {
            parts: List(&Text), count: Integer, prefixes: List(&List(&Text)), names: List(&Text), adapter?: Flag,
        },
        NoTensors = "no-tensors" { shards: Integer },
        NoWeights = "no-weights" { model: Flag, unread?: List(&Text), foreign?: List(&Text) },
        OwnModuleAsPackage = "own-module-as-package" { module: Text, packages: List(&Text) },
        PatternsNotCompared = "patterns-not-compared" {},
        PickleGlobalHarmful = "pickle-global-harmful" {
            imports: List(&Text), count: Integer, import: Text, offset: Integer, called: Flag,
        },
        PickleGlobalRefused = "pickle-global-refused" {
            imports: List(&Text), count: Integer, import: Text, offset: Integer, called: Flag,
        },
        PickleGlobalUnknown = "pickle-global-unknown" {
            imports: List(&Text), count: Integer, import: Text, offset: Integer, called: Flag, content: Text,
        },
        PickleOpcodeRefused = "pickle-opcode-refused" { opcodes: List(&Text), offset: Integer },
        PickleWeights = "pickle-weights" { tensors: Integer, read: Flag, reason?: Text, strided?: Integer },
        PlainThoughQuantized = "plain-though-quantized" { scheme: Text, module: Text },
        PostProcessorIdWrong = "post-processor-id-wrong" { token: Text, written: Integer, own: Integer },
        PostProcessorReplaced = "post-processor-replaced" { stored: Text, own: Text, class: Text },
        PrefixHijack = "prefix-hijack" { tensor: Text, by?: Text, under?: Text },
        PreprocessorSettingRefused = "preprocessor-setting-refused" { class: Text, key: Text, value?: Any },
        ProgramLacksClass = "program-lacks-class" { program: Text, name: Text, class: OrNull(&Text) },
        ProgramLacksModelType = "program-lacks-model-type" { program: Text, name: Text, model_type: Text },
        ProgramReadsOtherFiles = "program-reads-other-files" {
            program: Text, name: Text, read: List(&Text), others: List(&Text),
        },
        ProcessorFileMissing = "processor-file-missing" {
            class: Text, nested: OrNull(&Text), has_processor_config: Flag, content: OrNull(&Any),
        },
        ProcessorValueDiffers = "processor-value-differs" {
            key: Text, found: Any, needed: Any, because: Text, wrong: Text,
        },
        ProcessorValueMissing = "processor-value-missing" {
            keys: List(&Text), values: List(&Record(declared_keys! { key: Text, pointer: Text, needed: Any })),
            content: OrNull(&Any), because: List(&Text), wrong: Text,
        },
        QuantizeConfigDisagrees = "quantize-config-disagrees" { parameter: Text, said: Any, otherwise: Any },
        QuantizedConfigPlainTensors = "quantized-config-plain-tensors" { scheme: Text },
        QuantizedDtypeWrong = "quantized-dtype-wrong" { scheme: Text, module: Text, dtype: Text, allowed: Text },
        QuantMethodMissing = "quant-method-missing" { versions: List(&Text) },
        QuantMethodUnknown = "quant-method-unknown" { method: Text, versions: List(&Text) },
        QuantizedForAnotherLoader = "quantized-for-another-loader" { scheme: Text, program: Text },
        QuantizedModuleIncomplete = "quantized-module-incomplete" { scheme: Text, module: Text, lacks: List(&Text) },
        QuantizedShapeWrong = "quantized-shape-wrong" {
            scheme: Text, module: Text, stored: List(&Integer), expected: List(&Integer), fits: Text,
        },
        QuantizedThoughSkipped = "quantized-though-skipped" { scheme: Text, module: Text },
        QuantizedUndeclared = "quantized-undeclared" {
            scheme: Text, module: Text, unread?: Text, by?: List(&Text),
        },
        RelativeImportMissing = "relative-import-missing" { module: Text, imported: Text, target: Text },
        RopeParametersUnread = "rope-parameters-unread" {
            given: Flag, unwritable: Flag, at: Text, key: Text, keys: List(&Text), read: Any, needed: Any,
            values: List(&Record(declared_keys! { key: Text, pointer: Text, needed: Any, read: Any, given: Flag })),
        },
        SequencesRefused = "sequences-refused" { sequences: Any, beams: Any, raises: Text, generates: Flag },
        ShardMissing = "shard-missing" { shard: Text, tensors: OrNull(&Integer) },
        ShardNameDiffersInCase = "shard-name-differs-in-case" {
            similar: Text, by: Text, shard: Text, tensors: OrNull(&Integer),
        },
        ShardTensorNotInIndex = "shard-tensor-not-in-index" { index: Text },
        SingleFileBesideIndex = "single-file-beside-index" { index: Text, twice: Integer },
        StatisticsImplausible = "statistics-implausible" {
            set: Text, statistic: Text, dimension: Integer, value: OrNull(&Number),
        },
        StatisticsNotFinite = "statistics-not-finite" {
            set: Text, statistic: Text, dimension: Integer, width: Integer,
        },
        StatisticsOutOfOrder = "statistics-out-of-order" {
            set: Text, low: Text, high: Text, low_value: OrNull(&Number), high_value: OrNull(&Number),
            dimension: Integer,
        },
        StatisticsWidthsDiffer = "statistics-widths-differ" {
            set: Text, one: Text, one_width: Integer, other: Text, other_width: Integer,
        },
        StrayShard = "stray-shard" { index: Text, twice: Integer },
        SuppressionUnused = "suppression-unused" { rule: Text, path: Text, written: Text, reason: Text },
        TemplateNeedsProcess = "template-needs-process" { reason: Text },
        TemplateNotRendered = "template-not-rendered" { reason: Text },
        TemplateSyntax = "template-syntax" { line: Integer, reason: Text },
        TensorInTwoShards = "tensor-in-two-shards" { other: Text, mapped: Text, taken: Text, differs: OrNull(&Flag), not_judged?: Text },
        TiedOver = "tied-over" { tensor: Text, by: Text, under?: Text },
        TiedOverAnother = "tied-over-another" { tensor: Text, by: Text, under?: Text },
        TokenAboveRows = "token-above-rows" {
            count: Integer, first: Integer, last: Integer, token: Text, rows: Integer,
        },
        TokenHole = "token-hole" { missing: Integer, next: Integer, token: Text },
        TokenIdTwice = "token-id-twice" { token: Text, first: Integer, second: Integer },
        TokenizerModelOfOtherType = "tokenizer-model-of-other-type" {
            type: Text, model: Text, raises?: Text, class: Text,
        },
        TokenizerPartUnknown = "tokenizer-part-unknown" { part: Text, type: Text },
        TokenizerSettingRefused = "tokenizer-setting-refused" { class: Text, key: Text, value?: Any },
        TokenizerValueRefused = "tokenizer-value-refused" { key: Text, value?: Any },
        TotalSizeNotOfClass = "total-size-not-of-class" {
            stated: Integer, computed: Integer, class: Text, value?: Text, others?: Text,
        },
        TotalSizeWrong = "total-size-wrong" { stated: Integer, actual: Integer },
        TurnEndsElsewhere = "turn-ends-elsewhere" { token: Text, id: Integer, of: Text, ids: List(&Integer) },
        UnbuiltTensors = "unbuilt-tensors" { count: Integer, names: List(&Text), under?: Text },
        UnexpectedTensors = "unexpected-tensors" { count: Integer, names: List(&Text), under?: Text },
        UnknownArchitecture = "unknown-architecture" {
            model_type: Text, class: Text, part?: Text, likely?: Text, likely_type?: Text, under?: Text,
        },
        UnknownQuantization = "unknown-quantization" { method: Text },
        ValueRefused = "value-refused" { key: Text, value: Any, because: Text, raises: Text, similar?: Text },
    }
}

impl FaultKind {
    /// The keys of the details of such a fault, which rules may use.
    #[cfg(feature = "internals")]
    #[must_use]
    pub const fn details(self) -> &'static [DeclaredKey] {
        self.declared()
    }

    /// Whether faults of this kind have a detail of this name and type.
    pub(super) fn declares(self, name: &str, value: &Value) -> bool {
        self.declared().iter().any(|key| key.name == name && key.value_type.accepts(value))
    }
}

impl fmt::Display for FaultKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Serialize for FaultKind {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

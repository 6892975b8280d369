//! The kinds of fault: one list with the name of each kind and the stage that produces it.

use std::fmt;

use serde::{Serialize, Serializer};

/// The stage that produces faults of a kind.
#[cfg(feature = "internals")]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FaultSource {
    /// The readers in `checkpoint`, from one file.
    Reader,
    /// The comparisons in `check`, from several files or from knowledge.
    Comparison,
}

/// Declares [`FaultKind`] from lines `Variant = "kebab-case-name"`, grouped by the stage that produces them.
macro_rules! fault_kinds {
    ($($source:ident { $($variant:ident = $name:literal,)* })*) => {
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
        AppendedSection = "appended-section",
        ByteOrderMark = "byte-order-mark",
        CheckpointTooLarge = "checkpoint-too-large",
        CommentInJson = "comment-in-json",
        ContentEdited = "content-edited",
        ContentHashDiffers = "content-hash-differs",
        ContentsUnread = "contents-unread",
        DanglingSymlink = "dangling-symlink",
        DataHole = "data-hole",
        DuplicateHeaderKey = "duplicate-header-key",
        DuplicateIndexKey = "duplicate-index-key",
        DuplicateJsonKey = "duplicate-json-key",
        EmptyDocument = "empty-document",
        EmptyFile = "empty-file",
        EntryMalformed = "entry-malformed",
        FileTooLarge = "file-too-large",
        FileTooShort = "file-too-short",
        HeaderLengthOutOfRange = "header-length-out-of-range",
        HeaderNotJson = "header-not-json",
        HeaderNotUtf8 = "header-not-utf8",
        HeaderPaddingNotSpaces = "header-padding-not-spaces",
        HeaderTooDeep = "header-too-deep",
        HeaderTooLarge = "header-too-large",
        HtmlInstead = "html-instead",
        HugeNumber = "huge-number",
        IndexMetadataMissing = "index-metadata-missing",
        IndexUnsafePath = "index-unsafe-path",
        InvalidUtf8 = "invalid-utf8",
        JsonSyntax = "json-syntax",
        JsonTooDeep = "json-too-deep",
        JsonTooManyValues = "json-too-many-values",
        LfsPointer = "lfs-pointer",
        LinkNotFollowed = "link-not-followed",
        LoneSurrogate = "lone-surrogate",
        MergeConflictMarker = "merge-conflict-marker",
        MetadataNotStrings = "metadata-not-strings",
        MetadataNull = "metadata-null",
        MissingComma = "missing-comma",
        NoFormatMetadata = "no-format-metadata",
        NonFiniteNumber = "non-finite-number",
        NonFiniteWeights = "non-finite-weights",
        NotARegularFile = "not-a-regular-file",
        NotAnObject = "not-an-object",
        NotSafetensors = "not-safetensors",
        NulBytes = "nul-bytes",
        NotATorchFile = "not-a-torch-file",
        OddTensorName = "odd-tensor-name",
        OffsetsOutOfOrder = "offsets-out-of-order",
        PartialDownload = "partial-download",
        PickleCutShort = "pickle-cut-short",
        PickleMalformed = "pickle-malformed",
        PickleNested = "pickle-nested",
        PickleNotAStateDict = "pickle-not-a-state-dict",
        PickleStorageWrong = "pickle-storage-wrong",
        PickleTensorOutOfRange = "pickle-tensor-out-of-range",
        PickleTooLarge = "pickle-too-large",
        PythonSyntax = "python-syntax",
        PythonTooComplex = "python-too-complex",
        RepairInterrupted = "repair-interrupted",
        ShapeByteMismatch = "shape-byte-mismatch",
        ShapeOverflow = "shape-overflow",
        ShardTruncated = "shard-truncated",
        SingleQuotedString = "single-quoted-string",
        SubByteMisaligned = "sub-byte-misaligned",
        SymlinkLoop = "symlink-loop",
        SymlinkOutside = "symlink-outside",
        TensorsOverlap = "tensors-overlap",
        TotalSizeMalformed = "total-size-malformed",
        TrailingBytes = "trailing-bytes",
        TrailingComma = "trailing-comma",
        TrailingContent = "trailing-content",
        UnknownDtype = "unknown-dtype",
        UnreadableFile = "unreadable-file",
        VocabularyMalformed = "vocabulary-malformed",
        WeightMapMalformed = "weight-map-malformed",
        WeightMapMissing = "weight-map-missing",
        WrongEncoding = "wrong-encoding",
        ZeroTail = "zero-tail",
    }
    Comparison {
        AdapterBaseDiffers = "adapter-base-differs",
        AdapterBaseIsAPath = "adapter-base-is-a-path",
        AdapterBesideModel = "adapter-beside-model",
        AdapterConfigKeyGone = "adapter-config-key-gone",
        AdapterConfigKeyUnknown = "adapter-config-key-unknown",
        AdapterDoraDisagrees = "adapter-dora-disagrees",
        AdapterKeyUnread = "adapter-key-unread",
        AdapterMagnitudeMisshapen = "adapter-magnitude-misshapen",
        AdapterModuleNotSaved = "adapter-module-not-saved",
        AdapterModuleUntargeted = "adapter-module-untargeted",
        AdapterNamesCut = "adapter-names-cut",
        AdapterOfAModel = "adapter-of-a-model",
        AdapterOfAnotherFormat = "adapter-of-another-format",
        AdapterPairIncomplete = "adapter-pair-incomplete",
        AdapterRankDisagrees = "adapter-rank-disagrees",
        AdapterRankUnusable = "adapter-rank-unusable",
        AdapterTensorsEmpty = "adapter-tensors-empty",
        AdapterTypeMissing = "adapter-type-missing",
        AdapterTypeUnchecked = "adapter-type-unchecked",
        AdapterTypeUnknown = "adapter-type-unknown",
        AdapterValueRefused = "adapter-value-refused",
        AdapterWeightsMissing = "adapter-weights-missing",
        AdapterWithoutMatrices = "adapter-without-matrices",
        AddedTokenMoved = "added-token-moved",
        AddedTokensDisagree = "added-tokens-disagree",
        AddedTokensDropped = "added-tokens-dropped",
        AliasMissesImport = "alias-misses-import",
        AllShardsAbsent = "all-shards-absent",
        AutoMapClassMissing = "auto-map-class-missing",
        AutoMapMalformed = "auto-map-malformed",
        AutoMapModuleMissing = "auto-map-module-missing",
        AutoMapNestedMissing = "auto-map-nested-missing",
        AutoMapRemote = "auto-map-remote",
        AutoMapUnsafePath = "auto-map-unsafe-path",
        BeginTwice = "begin-twice",
        CardBaseIsAPath = "card-base-is-a-path",
        ClassNameUnknown = "class-name-unknown",
        ClassOfWholeModel = "class-of-whole-model",
        ConfigIncomputable = "config-incomputable",
        ConfigOutvoted = "config-outvoted",
        DirectoryNameWithDot = "directory-name-with-dot",
        DirectoryRecognised = "directory-recognised",
        EmptyTensors = "empty-tensors",
        IndexEntryNotAShard = "index-entry-not-a-shard",
        IndexKeyNowhere = "index-key-nowhere",
        IndexMissing = "index-missing",
        IndexNamesOtherShard = "index-names-other-shard",
        IntegerWeights = "integer-weights",
        LayerLacksTensor = "layer-lacks-tensor",
        LfsSizesBelowTotal = "lfs-sizes-below-total",
        LfsSizesNotOfClass = "lfs-sizes-not-of-class",
        LoadRaises = "load-raises",
        LoadsDiffer = "loads-differ",
        MergesArePairs = "merges-are-pairs",
        MismatchedTensor = "mismatched-tensor",
        MissingTensors = "missing-tensors",
        ModelTypeMissing = "model-type-missing",
        ModelTypeUnknown = "model-type-unknown",
        ModuleImportGone = "module-import-gone",
        ModuleNeedsPackage = "module-needs-package",
        NamesMoved = "names-moved",
        NamesWrapped = "names-wrapped",
        NoTensors = "no-tensors",
        NoWeights = "no-weights",
        OwnModuleAsPackage = "own-module-as-package",
        PickleGlobalHarmful = "pickle-global-harmful",
        PickleGlobalRefused = "pickle-global-refused",
        PickleOpcodeRefused = "pickle-opcode-refused",
        PickleWeights = "pickle-weights",
        PlainThoughQuantized = "plain-though-quantized",
        PostProcessorIdWrong = "post-processor-id-wrong",
        PostProcessorReplaced = "post-processor-replaced",
        PrefixHijack = "prefix-hijack",
        ProgramLacksClass = "program-lacks-class",
        ProgramLacksModelType = "program-lacks-model-type",
        ProgramReadsOtherFiles = "program-reads-other-files",
        ProcessorFileMissing = "processor-file-missing",
        ProcessorValueDiffers = "processor-value-differs",
        ProcessorValueMissing = "processor-value-missing",
        QuantizeConfigDisagrees = "quantize-config-disagrees",
        QuantizedConfigPlainTensors = "quantized-config-plain-tensors",
        QuantizedDtypeWrong = "quantized-dtype-wrong",
        QuantMethodMissing = "quant-method-missing",
        QuantMethodUnknown = "quant-method-unknown",
        QuantizedForAnotherLoader = "quantized-for-another-loader",
        QuantizedModuleIncomplete = "quantized-module-incomplete",
        QuantizedShapeWrong = "quantized-shape-wrong",
        QuantizedThoughSkipped = "quantized-though-skipped",
        QuantizedUndeclared = "quantized-undeclared",
        RelativeImportMissing = "relative-import-missing",
        RopeParametersUnread = "rope-parameters-unread",
        ShardMissing = "shard-missing",
        ShardNameDiffersInCase = "shard-name-differs-in-case",
        ShardTensorNotInIndex = "shard-tensor-not-in-index",
        SingleFileBesideIndex = "single-file-beside-index",
        StatisticsImplausible = "statistics-implausible",
        StatisticsNotFinite = "statistics-not-finite",
        StatisticsOutOfOrder = "statistics-out-of-order",
        StatisticsWidthsDiffer = "statistics-widths-differ",
        StrayShard = "stray-shard",
        SuppressionUnused = "suppression-unused",
        TemplateNotRendered = "template-not-rendered",
        TemplateSyntax = "template-syntax",
        TensorInTwoShards = "tensor-in-two-shards",
        TiedOver = "tied-over",
        TiedOverAnother = "tied-over-another",
        TokenAboveRows = "token-above-rows",
        TokenHole = "token-hole",
        TokenIdTwice = "token-id-twice",
        TokenizerModelOfOtherType = "tokenizer-model-of-other-type",
        TokenizerPartUnknown = "tokenizer-part-unknown",
        TotalSizeNotOfClass = "total-size-not-of-class",
        TotalSizeWrong = "total-size-wrong",
        TurnEndsElsewhere = "turn-ends-elsewhere",
        UnbuiltTensors = "unbuilt-tensors",
        UnexpectedTensors = "unexpected-tensors",
        UnknownArchitecture = "unknown-architecture",
        UnknownQuantization = "unknown-quantization",
        ValueRefused = "value-refused",
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

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
        OddTensorName = "odd-tensor-name",
        OffsetsOutOfOrder = "offsets-out-of-order",
        PartialDownload = "partial-download",
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
        AdapterBaseIsAPath = "adapter-base-is-a-path",
        AdapterDoraDisagrees = "adapter-dora-disagrees",
        AdapterKeyUnread = "adapter-key-unread",
        AdapterMagnitudeMisshapen = "adapter-magnitude-misshapen",
        AdapterModuleNotSaved = "adapter-module-not-saved",
        AdapterModuleUntargeted = "adapter-module-untargeted",
        AdapterOfAModel = "adapter-of-a-model",
        AdapterPairIncomplete = "adapter-pair-incomplete",
        AdapterRankDisagrees = "adapter-rank-disagrees",
        AdapterRankUnusable = "adapter-rank-unusable",
        AdapterTensorsEmpty = "adapter-tensors-empty",
        AdapterTypeMissing = "adapter-type-missing",
        AdapterTypeUnchecked = "adapter-type-unchecked",
        AdapterWeightsMissing = "adapter-weights-missing",
        AdapterWithoutMatrices = "adapter-without-matrices",
        AddedTokensDisagree = "added-tokens-disagree",
        AliasMissesImport = "alias-misses-import",
        AllShardsAbsent = "all-shards-absent",
        AutoMapClassMissing = "auto-map-class-missing",
        AutoMapMalformed = "auto-map-malformed",
        AutoMapModuleMissing = "auto-map-module-missing",
        AutoMapNestedMissing = "auto-map-nested-missing",
        AutoMapRemote = "auto-map-remote",
        AutoMapUnsafePath = "auto-map-unsafe-path",
        ConfigIncomputable = "config-incomputable",
        ConfigOutvoted = "config-outvoted",
        DirectoryNameWithDot = "directory-name-with-dot",
        EmptyTensors = "empty-tensors",
        IndexEntryNotAShard = "index-entry-not-a-shard",
        IndexKeyNowhere = "index-key-nowhere",
        IndexMissing = "index-missing",
        IndexNamesOtherShard = "index-names-other-shard",
        IntegerWeights = "integer-weights",
        LayerLacksTensor = "layer-lacks-tensor",
        LfsSizesBelowTotal = "lfs-sizes-below-total",
        LoadRaises = "load-raises",
        LoadsDiffer = "loads-differ",
        MismatchedTensor = "mismatched-tensor",
        MissingTensors = "missing-tensors",
        ModelTypeMissing = "model-type-missing",
        ModelTypeUnknown = "model-type-unknown",
        ModuleNeedsPackage = "module-needs-package",
        NamesMoved = "names-moved",
        NoTensors = "no-tensors",
        NoWeights = "no-weights",
        OwnModuleAsPackage = "own-module-as-package",
        PickleWeights = "pickle-weights",
        PlainThoughQuantized = "plain-though-quantized",
        PrefixHijack = "prefix-hijack",
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
        ShardMissing = "shard-missing",
        ShardNameDiffersInCase = "shard-name-differs-in-case",
        ShardTensorNotInIndex = "shard-tensor-not-in-index",
        SingleFileBesideIndex = "single-file-beside-index",
        StrayShard = "stray-shard",
        SuppressionUnused = "suppression-unused",
        TensorInTwoShards = "tensor-in-two-shards",
        TiedOver = "tied-over",
        TiedOverAnother = "tied-over-another",
        TokenAboveRows = "token-above-rows",
        TokenHole = "token-hole",
        TokenIdTwice = "token-id-twice",
        TotalSizeNotOfClass = "total-size-not-of-class",
        TotalSizeWrong = "total-size-wrong",
        UnexpectedTensors = "unexpected-tensors",
        UnknownArchitecture = "unknown-architecture",
        UnknownQuantization = "unknown-quantization",
        ValueRefused = "value-refused",
    }
}

impl FaultKind {
    /// The kind of this name; `None` for an unknown name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|kind| kind.name() == name)
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

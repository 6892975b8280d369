# Print an optspec for argparse to handle cmd's options that are independent of any subcommand.
function __fish_ckpt_doctor_global_optspecs
    string join \n rules= h/help V/version
end

function __fish_ckpt_doctor_needs_command
    # Figure out if the current invocation already has a command.
    set -l cmd (commandline -opc)
    set -e cmd[1]
    argparse -s (__fish_ckpt_doctor_global_optspecs) -- $cmd 2>/dev/null
    or return
    if set -q argv[1]
        # Also print the command, so this can be used to figure out what it is.
        echo $argv[1]
        return 1
    end
    return 0
end

function __fish_ckpt_doctor_using_subcommand
    set -l cmd (__fish_ckpt_doctor_needs_command)
    test -z "$cmd"
    and return 1
    contains -- $cmd[1] $argv
end

complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -s h -l help -d 'Print help'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "check" -d 'Check checkpoint directories; with --fix, repair them'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "undo" -d 'Undo the latest repair of each checkpoint, byte for byte'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "build-merged" -d 'Build one checkpoint from parts of two others'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "merge" -d 'Build one checkpoint from parts of two others'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "extract" -d 'Take a part out of a model, as a checkpoint of its own class'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "insert" -d 'Put a part into a model, such as a language model that was trained on text alone'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "merge-adapter" -d 'Merge a LoRA of PEFT into the model that it was trained on'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "verify" -d 'Compare a merged checkpoint with its manifest and, byte for byte, with its donors'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "inspect" -d 'Summarise a checkpoint: tensors, model class, inferred config values'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "diff" -d 'Compare two checkpoints: tensors under one naming, config values, tokens and files'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "compare" -d 'Compare two checkpoints: tensors under one naming, config values, tokens and files'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "expect" -d 'Print the tensors that a model class expects, from its config alone'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "explain" -d 'Print the documentation of a rule or a recipe'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "rules" -d 'List the rules'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "recipes" -d 'List the recipes of build-merged, with what each donor has to be'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "init" -d 'Write a settings file, ckpt-doctor.json5, with every key explained'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "completions" -d 'Print the completions for a shell'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "man" -d 'Print a page of the manual'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_needs_command" -f -a "help" -d 'Print this message or the help of the given subcommand(s)'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l for -d 'Predict the load for these versions: 4.57, transformers==4.57.3, or all; peft==0.13.2 for adapters; vllm, mlx-lm and llama.cpp for what is known of them; @FILE for those that a lock file, pyproject.toml or requirements file pins; may be repeated [default: the version that wrote config.json, and the newest known of each major version]' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l for-python -d 'As --for, for the versions of transformers and PEFT that this Python interpreter has: it is started to list them, and nothing of a model is run' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l follow-links -d 'Read files through symbolic links that lead into this directory; may be repeated. Other links out of a checkpoint are not followed, except into the Hub cache' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l base -d 'The base model of the adapters. Without it, they are compared with the one beside them, with one among the paths, or with one that was downloaded from the Hub' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -s j -l jobs -d 'Directories that are checked at once, each by a process of its own [default: one for each processor, at most 16]' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l select -d 'Run only these rules: codes, prefixes of codes (JSN) or names, comma-separated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l extend-select -d 'Run these rules in addition to those that the settings select' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l ignore -d 'Skip these rules; if --select and --ignore both match a rule, the longer selector wins' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l config -d 'Use this settings file instead of the nearest ckpt-doctor.json5 from the working directory upward' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l baseline -d 'Do not count the findings listed in this file, and list those that no longer occur' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l output -d 'With --fix: write a repaired copy to this directory and leave the checkpoint unchanged; files without changes become hard links to the originals (on another file system, copies or, above 64 MiB, symbolic links)' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l output-format -d 'Format of the report on standard output' -r -f -a "full\t''
table\t''
concise\t''
json\t''
jsonl\t''
github\t''
gitlab\t''
junit\t''
sarif\t''
markdown\t''
html\t''"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l report -d 'Also write the report to a file in any of these formats; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l fail-on -d 'Lowest severity that makes the exit code 1 [default: error]' -r -f -a "info\t'All findings'
warning\t'Warnings and errors'
error\t'Errors only'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l color -d 'When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`' -r -f -a "auto\t'On a terminal'
always\t'Always'
never\t'Never'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l min-severity -d 'Lowest severity that is reported; the exit code depends on --fail-on alone [default: info]' -r -f -a "info\t'All findings'
warning\t'Warnings and errors'
error\t'Errors only'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l deep -d 'Also read the bytes of every tensor, to find NaN, infinity, trailing zeros and tied weights that differ'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l stats -d 'As --deep, and show smallest and largest value, mean, root mean square, zeros and denormals of each tensor (formats full and json)'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l hash -d 'Also hash the files whose hash the Hub cache, a local download or git recorded, to find changed ones'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l metadata-only -d 'Accept checkpoints without weights, such as copies of the documents alone; their load is not predicted'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l isolated -d 'Use no settings file'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l write-baseline -d 'Write the current findings to the baseline instead of comparing with it'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l fix -d 'Apply the safe fixes; `ckpt-doctor undo` restores the originals'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l unsafe-fixes -d 'Also apply (or, without --fix, mark) the unsafe fixes: they change values or tensor names that a loader reads'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l diff -d 'Show the changes that the fixes would make, and write nothing'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l fix-only -d 'Apply the fixes as --fix does, but neither report the remaining findings nor fail because of them'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l exit-non-zero-on-fix -d 'Exit with 1 if anything was fixed, even if no finding remains'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l adopt-journal -d 'With --fix: also finish or roll back an interrupted repair that you did not begin in this directory, such as one in a copy. Its journal decides which files are written, so know where the directory comes from'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l exit-zero -d 'Exit with 0 even if there are findings'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -l statistics -d 'Count the findings of each rule instead of showing them (formats full, concise and json)'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -s q -l quiet -d 'Print findings only: neither the table, checkpoints without findings nor the summary (formats full and concise); rows with findings only (format table)'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -s v -l verbose -d 'Explain why each skipped rule was skipped'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -s h -l help -d 'Print help (see more with \'--help\')'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand check" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand undo" -l rules -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand undo" -l adopt-journal -d 'Also undo a repair that you did not make in this directory, such as one in a copy. Its journal decides which files are written, so know where the directory comes from. For one checkpoint alone'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand undo" -s h -l help -d 'Print help'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand undo" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l recipe -d 'Name of a recipe (see `ckpt-doctor recipes`), or a JSON5 file' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l donor -d 'Checkpoint that supplies the parts of a role; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l vision -d 'Short for --donor vision=DIR' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l language -d 'Short for --donor language=DIR' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l out -d 'Output directory; it must not exist, or be empty' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l set -d 'Set an option of the recipe; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l for -d 'Version of transformers that the result is for: 4.57, transformers==4.57.3, all, or @FILE for what a lock file pins; may be repeated. The result is checked for it, and options whose default depends on the version follow it' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l tolerate -d 'Let errors of this rule, in a donor or the result, not stop the merge; they are reported, and the exit code is 1 for one in the result. May be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l plan -d 'With --dry-run: write the plan, every tensor with its shard and source, to this file as JSON' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l hash -d 'Algorithm of the digests of tensors in the manifest, with which `ckpt-doctor verify` compares the result' -r -f -a "none\t'No digests; the donors are needed to verify the result'
blake3\t'BLAKE3'
sha256\t'SHA-256'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l output-format -d 'Format of the report on standard output' -r -f -a "full\t''
table\t''
concise\t''
json\t''
jsonl\t''
github\t''
gitlab\t''
junit\t''
sarif\t''
markdown\t''
html\t''"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l report -d 'Also write the report to a file in any of these formats; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l fail-on -d 'Lowest severity that makes the exit code 1 [default: error]' -r -f -a "info\t'All findings'
warning\t'Warnings and errors'
error\t'Errors only'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l color -d 'When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`' -r -f -a "auto\t'On a terminal'
always\t'Always'
never\t'Never'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l print-recipe -d 'Print the text of the recipe, and do nothing else'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -s h -l help -d 'Print help; with --recipe, print the donors and options of the recipe'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l dry-run -d 'Plan and check the merge, and write nothing'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l hash-donors -d 'Record the SHA-256 of whole donor files in the manifest, not only of documents and shard headers'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -l exit-zero -d 'Exit with 0 even if there are findings'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand build-merged" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l recipe -d 'Name of a recipe (see `ckpt-doctor recipes`), or a JSON5 file' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l donor -d 'Checkpoint that supplies the parts of a role; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l vision -d 'Short for --donor vision=DIR' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l language -d 'Short for --donor language=DIR' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l out -d 'Output directory; it must not exist, or be empty' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l set -d 'Set an option of the recipe; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l for -d 'Version of transformers that the result is for: 4.57, transformers==4.57.3, all, or @FILE for what a lock file pins; may be repeated. The result is checked for it, and options whose default depends on the version follow it' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l tolerate -d 'Let errors of this rule, in a donor or the result, not stop the merge; they are reported, and the exit code is 1 for one in the result. May be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l plan -d 'With --dry-run: write the plan, every tensor with its shard and source, to this file as JSON' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l hash -d 'Algorithm of the digests of tensors in the manifest, with which `ckpt-doctor verify` compares the result' -r -f -a "none\t'No digests; the donors are needed to verify the result'
blake3\t'BLAKE3'
sha256\t'SHA-256'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l output-format -d 'Format of the report on standard output' -r -f -a "full\t''
table\t''
concise\t''
json\t''
jsonl\t''
github\t''
gitlab\t''
junit\t''
sarif\t''
markdown\t''
html\t''"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l report -d 'Also write the report to a file in any of these formats; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l fail-on -d 'Lowest severity that makes the exit code 1 [default: error]' -r -f -a "info\t'All findings'
warning\t'Warnings and errors'
error\t'Errors only'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l color -d 'When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`' -r -f -a "auto\t'On a terminal'
always\t'Always'
never\t'Never'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l print-recipe -d 'Print the text of the recipe, and do nothing else'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -s h -l help -d 'Print help; with --recipe, print the donors and options of the recipe'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l dry-run -d 'Plan and check the merge, and write nothing'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l hash-donors -d 'Record the SHA-256 of whole donor files in the manifest, not only of documents and shard headers'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -l exit-zero -d 'Exit with 0 even if there are findings'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l part -d 'Name of the part, such as language or vision, or the JSON pointer of its config' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l out -d 'Output directory; it must not exist, or be empty' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l set -d 'Set an option of the recipe; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l for -d 'Version of transformers that the result is for: 4.57, transformers==4.57.3, all, or @FILE for what a lock file pins; may be repeated. The result is checked for it, and options whose default depends on the version follow it' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l tolerate -d 'Let errors of this rule, in a donor or the result, not stop the merge; they are reported, and the exit code is 1 for one in the result. May be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l plan -d 'With --dry-run: write the plan, every tensor with its shard and source, to this file as JSON' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l hash -d 'Algorithm of the digests of tensors in the manifest, with which `ckpt-doctor verify` compares the result' -r -f -a "none\t'No digests; the donors are needed to verify the result'
blake3\t'BLAKE3'
sha256\t'SHA-256'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l output-format -d 'Format of the report on standard output' -r -f -a "full\t''
table\t''
concise\t''
json\t''
jsonl\t''
github\t''
gitlab\t''
junit\t''
sarif\t''
markdown\t''
html\t''"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l report -d 'Also write the report to a file in any of these formats; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l fail-on -d 'Lowest severity that makes the exit code 1 [default: error]' -r -f -a "info\t'All findings'
warning\t'Warnings and errors'
error\t'Errors only'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l color -d 'When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`' -r -f -a "auto\t'On a terminal'
always\t'Always'
never\t'Never'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l dry-run -d 'Plan and check the merge, and write nothing'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l hash-donors -d 'Record the SHA-256 of whole donor files in the manifest, not only of documents and shard headers'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -l exit-zero -d 'Exit with 0 even if there are findings'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -s h -l help -d 'Print help (see more with \'--help\')'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand extract" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l part -d 'Name of the part, such as language or vision, or the JSON pointer of its config' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l from -d 'The part as a checkpoint of its own' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l out -d 'Output directory; it must not exist, or be empty' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l set -d 'Set an option of the recipe; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l for -d 'Version of transformers that the result is for: 4.57, transformers==4.57.3, all, or @FILE for what a lock file pins; may be repeated. The result is checked for it, and options whose default depends on the version follow it' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l tolerate -d 'Let errors of this rule, in a donor or the result, not stop the merge; they are reported, and the exit code is 1 for one in the result. May be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l plan -d 'With --dry-run: write the plan, every tensor with its shard and source, to this file as JSON' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l hash -d 'Algorithm of the digests of tensors in the manifest, with which `ckpt-doctor verify` compares the result' -r -f -a "none\t'No digests; the donors are needed to verify the result'
blake3\t'BLAKE3'
sha256\t'SHA-256'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l output-format -d 'Format of the report on standard output' -r -f -a "full\t''
table\t''
concise\t''
json\t''
jsonl\t''
github\t''
gitlab\t''
junit\t''
sarif\t''
markdown\t''
html\t''"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l report -d 'Also write the report to a file in any of these formats; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l fail-on -d 'Lowest severity that makes the exit code 1 [default: error]' -r -f -a "info\t'All findings'
warning\t'Warnings and errors'
error\t'Errors only'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l color -d 'When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`' -r -f -a "auto\t'On a terminal'
always\t'Always'
never\t'Never'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l dry-run -d 'Plan and check the merge, and write nothing'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l hash-donors -d 'Record the SHA-256 of whole donor files in the manifest, not only of documents and shard headers'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -l exit-zero -d 'Exit with 0 even if there are findings'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -s h -l help -d 'Print help (see more with \'--help\')'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand insert" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l out -d 'Output directory; it must not exist, or be empty' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l set -d 'Set an option of the recipe; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l for -d 'Version of transformers that the result is for: 4.57, transformers==4.57.3, all, or @FILE for what a lock file pins; may be repeated. The result is checked for it, and options whose default depends on the version follow it' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l tolerate -d 'Let errors of this rule, in a donor or the result, not stop the merge; they are reported, and the exit code is 1 for one in the result. May be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l plan -d 'With --dry-run: write the plan, every tensor with its shard and source, to this file as JSON' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l hash -d 'Algorithm of the digests of tensors in the manifest, with which `ckpt-doctor verify` compares the result' -r -f -a "none\t'No digests; the donors are needed to verify the result'
blake3\t'BLAKE3'
sha256\t'SHA-256'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l output-format -d 'Format of the report on standard output' -r -f -a "full\t''
table\t''
concise\t''
json\t''
jsonl\t''
github\t''
gitlab\t''
junit\t''
sarif\t''
markdown\t''
html\t''"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l report -d 'Also write the report to a file in any of these formats; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l fail-on -d 'Lowest severity that makes the exit code 1 [default: error]' -r -f -a "info\t'All findings'
warning\t'Warnings and errors'
error\t'Errors only'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l color -d 'When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`' -r -f -a "auto\t'On a terminal'
always\t'Always'
never\t'Never'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l dry-run -d 'Plan and check the merge, and write nothing'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l hash-donors -d 'Record the SHA-256 of whole donor files in the manifest, not only of documents and shard headers'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -l exit-zero -d 'Exit with 0 even if there are findings'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -s h -l help -d 'Print help (see more with \'--help\')'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand merge-adapter" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand verify" -l donor -d 'Recompute the tensors that were made from this donor, and compare them byte for byte; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand verify" -l output-format -d 'Output format' -r -f -a "full\t'For a terminal'
json\t'One JSON object, complete'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand verify" -l color -d 'When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`' -r -f -a "auto\t'On a terminal'
always\t'Always'
never\t'Never'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand verify" -l rules -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand verify" -s h -l help -d 'Print help (see more with \'--help\')'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand verify" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand inspect" -l depth -d 'Print the tree of modules to N levels, 0 for all; without it, as many as stay short. JSON has all' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand inspect" -l tensors -d 'List the tensors, or those whose names match GLOB (`*` is any text): shape, dtype, bytes, and place in the files' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand inspect" -l context -d 'Tokens of the cache whose memory is estimated [default: the longest input that the config names]' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand inspect" -l batch -d 'Sequences of that cache' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand inspect" -l output-format -d 'Output format' -r -f -a "full\t'For a terminal'
json\t'One JSON object, complete'
html\t'A page for a browser, in one file'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand inspect" -l report -d 'Also write the output to a file in any of these formats; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand inspect" -l color -d 'When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`' -r -f -a "auto\t'On a terminal'
always\t'Always'
never\t'Never'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand inspect" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand inspect" -s h -l help -d 'Print help (see more with \'--help\')'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand inspect" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand diff" -l stats -d 'Compare all bytes, and measure tensors that differ; with =rank also the rank of the difference of two matrices' -r -f -a "values\t'Norm and largest value of the difference, and the cosine of the angle'
rank\t'These, and the rank of the difference'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand diff" -l output-format -d 'Output format' -r -f -a "full\t'For a terminal'
json\t'One JSON object, complete'
html\t'A page for a browser, in one file'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand diff" -l report -d 'Also write the output to a file in any of these formats; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand diff" -l color -d 'When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`' -r -f -a "auto\t'On a terminal'
always\t'Always'
never\t'Never'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand diff" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand diff" -l bytes -d 'Compare all bytes of tensors that have the same type and shape, not only the first, middle and last ones'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand diff" -s h -l help -d 'Print help (see more with \'--help\')'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand diff" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand compare" -l stats -d 'Compare all bytes, and measure tensors that differ; with =rank also the rank of the difference of two matrices' -r -f -a "values\t'Norm and largest value of the difference, and the cosine of the angle'
rank\t'These, and the rank of the difference'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand compare" -l output-format -d 'Output format' -r -f -a "full\t'For a terminal'
json\t'One JSON object, complete'
html\t'A page for a browser, in one file'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand compare" -l report -d 'Also write the output to a file in any of these formats; may be repeated' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand compare" -l color -d 'When to print colours; auto respects `NO_COLOR`, `FORCE_COLOR`, `CLICOLOR` and `TERM=dumb`' -r -f -a "auto\t'On a terminal'
always\t'Always'
never\t'Never'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand compare" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand compare" -l bytes -d 'Compare all bytes of tensors that have the same type and shape, not only the first, middle and last ones'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand compare" -s h -l help -d 'Print help (see more with \'--help\')'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand compare" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand expect" -l for -d 'Version of transformers that builds the class, as 4.57.3 or transformers==4.57.3, or @FILE for the one that a lock file pins; the nearest known version that has the class is used [default: the version that the config names]' -r
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand expect" -l output-format -d 'Output format; in jsonl, a config that fails has an "error" and the others are still printed' -r -f -a "text\t'One tensor per line'
json\t'A list with one object per config'
jsonl\t'One object per line and config'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand expect" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand expect" -s h -l help -d 'Print help (see more with \'--help\')'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand expect" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand explain" -l config -d 'Use this settings file instead of the nearest ckpt-doctor.json5 from the working directory upward' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand explain" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand explain" -l isolated -d 'Use no settings file'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand explain" -s h -l help -d 'Print help'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand explain" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand rules" -l config -d 'Use this settings file instead of the nearest ckpt-doctor.json5 from the working directory upward' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand rules" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand rules" -l isolated -d 'Use no settings file'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand rules" -s h -l help -d 'Print help'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand rules" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand recipes" -l output-format -d 'Output format' -r -f -a "text\t'For a terminal'
json\t'One JSON object, complete'"
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand recipes" -l rules -d 'Directory with extra rules (checks/**/*.json5), architectures (architectures/*.json5), processors (processors/*.json5) and recipes (recipes/*.json5); except for rules, a file replaces the built-in one of the same name' -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand recipes" -s h -l help -d 'Print help (see more with \'--help\')'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand recipes" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand init" -l rules -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand init" -l pre-commit -d 'Also write a .pre-commit-config.yaml'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand init" -s h -l help -d 'Print help'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand init" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand completions" -l rules -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand completions" -s h -l help -d 'Print help'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand completions" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand man" -l rules -r -F
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand man" -s h -l help -d 'Print help'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand man" -s V -l version -d 'Print version'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "check" -d 'Check checkpoint directories; with --fix, repair them'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "undo" -d 'Undo the latest repair of each checkpoint, byte for byte'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "build-merged" -d 'Build one checkpoint from parts of two others'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "extract" -d 'Take a part out of a model, as a checkpoint of its own class'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "insert" -d 'Put a part into a model, such as a language model that was trained on text alone'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "merge-adapter" -d 'Merge a LoRA of PEFT into the model that it was trained on'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "verify" -d 'Compare a merged checkpoint with its manifest and, byte for byte, with its donors'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "inspect" -d 'Summarise a checkpoint: tensors, model class, inferred config values'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "diff" -d 'Compare two checkpoints: tensors under one naming, config values, tokens and files'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "expect" -d 'Print the tensors that a model class expects, from its config alone'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "explain" -d 'Print the documentation of a rule or a recipe'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "rules" -d 'List the rules'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "recipes" -d 'List the recipes of build-merged, with what each donor has to be'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "init" -d 'Write a settings file, ckpt-doctor.json5, with every key explained'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "completions" -d 'Print the completions for a shell'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "man" -d 'Print a page of the manual'
complete -c ckpt-doctor -n "__fish_ckpt_doctor_using_subcommand help; and not __fish_seen_subcommand_from check undo build-merged extract insert merge-adapter verify inspect diff expect explain rules recipes init completions man help" -f -a "help" -d 'Print this message or the help of the given subcommand(s)'

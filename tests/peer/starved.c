/* Preloaded by crash.py: the allocation number FAIL_ALLOCATION of a process, from 0, finds no memory, and so do those after it
   when FAIL_ALLOCATION ends with "+". COUNT_ALLOCATIONS names a file that gets the number of allocations at the end. A process
   that uses a null pointer says so before it ends. */
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdint.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

extern void *__libc_malloc(size_t);
extern void *__libc_calloc(size_t, size_t);
extern void *__libc_realloc(void *, size_t);
extern void *__libc_memalign(size_t, size_t);

static atomic_long seen;
static long failing = -1;
static int on;

/* The standard library of Rust keeps a handler that is there before it. */
static void fault(int number, siginfo_t *info, void *context) {
    static const char words[] = "a null pointer was used\n";
    (void)context;
    if ((uintptr_t)info->si_addr < 4096 && write(STDERR_FILENO, words, sizeof words - 1) < 0) _exit(1);
    signal(number, SIG_DFL); /* The instruction faults again. */
}

__attribute__((constructor)) static void begin(void) {
    struct sigaction action = {.sa_sigaction = fault, .sa_flags = SA_SIGINFO | SA_ONSTACK};
    sigaction(SIGSEGV, &action, NULL);
    const char *at = getenv("FAIL_ALLOCATION");
    if (at) {
        failing = atol(at);
        on = strchr(at, '+') != NULL;
    }
}

__attribute__((destructor)) static void end(void) {
    const char *path = getenv("COUNT_ALLOCATIONS");
    char text[32];
    int file = path ? open(path, O_WRONLY | O_CREAT | O_TRUNC, 0600) : -1;
    if (file >= 0) {
        int length = snprintf(text, sizeof text, "%ld\n", atomic_load(&seen));
        if (write(file, text, (size_t)length) < 0) _exit(1);
        close(file);
    }
}

static int fails(void) {
    long number = atomic_fetch_add(&seen, 1);
    int failed = failing >= 0 && (number == failing || (on && number > failing));
    if (failed) errno = ENOMEM;
    return failed;
}

void *malloc(size_t size) { return fails() ? NULL : __libc_malloc(size); }
void *calloc(size_t count, size_t size) { return fails() ? NULL : __libc_calloc(count, size); }
void *realloc(void *old, size_t size) { return fails() ? NULL : __libc_realloc(old, size); }

int posix_memalign(void **out, size_t alignment, size_t size) {
    if (fails()) return ENOMEM;
    *out = __libc_memalign(alignment, size);
    return *out ? 0 : ENOMEM;
}

void *aligned_alloc(size_t alignment, size_t size) { return fails() ? NULL : __libc_memalign(alignment, size); }

/* Makes a file-system call of a program fail, or kills the program at this call. Loaded with LD_PRELOAD on Linux.
 *
 * A seccomp filter turns every such call into a SIGSYS. It also catches calls that bypass the C library. The handler
 * counts the call, and then makes it, fails it or kills the process.
 *
 * FAULT_AT     the number of the call that fails, from 1; with 0, calls are only counted
 * FAULT_KIND   ENOSPC, EIO, EROFS or KILL
 * FAULT_ALL    if it is set, all later calls fail, too
 * FAULT_COUNT  a file to which the number of calls is written when the process ends
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/audit.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <signal.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <ucontext.h>
#include <unistd.h>

/* Marks calls that the handler makes itself, as their sixth argument. No call below has six arguments. */
#define OURS 0x666c6f74u

#if defined(__x86_64__)
#define ARCH AUDIT_ARCH_X86_64
#define RESULT(c) (c)->uc_mcontext.gregs[REG_RAX]
#define ARGUMENTS(c)                                                                                                   \
    {(c)->uc_mcontext.gregs[REG_RDI], (c)->uc_mcontext.gregs[REG_RSI], (c)->uc_mcontext.gregs[REG_RDX],                \
     (c)->uc_mcontext.gregs[REG_R10], (c)->uc_mcontext.gregs[REG_R8]}
#elif defined(__aarch64__)
#define ARCH AUDIT_ARCH_AARCH64
#define RESULT(c) (c)->uc_mcontext.regs[0]
#define ARGUMENTS(c)                                                                                                   \
    {(c)->uc_mcontext.regs[0], (c)->uc_mcontext.regs[1], (c)->uc_mcontext.regs[2], (c)->uc_mcontext.regs[3],           \
     (c)->uc_mcontext.regs[4]}
#else
#error "the fault shim supports only x86-64 and AArch64"
#endif

/* Calls that can change files. `changes_disk` decides about each call. */
static const int WATCHED[] = {
#ifdef SYS_open
    SYS_open, SYS_creat, SYS_rename, SYS_unlink, SYS_mkdir, SYS_rmdir, SYS_link, SYS_symlink,
#endif
#ifdef SYS_renameat
    SYS_renameat,
#endif
    SYS_openat, SYS_write, SYS_pwrite64, SYS_writev, SYS_fsync, SYS_fdatasync, SYS_ftruncate, SYS_truncate,
    SYS_renameat2, SYS_unlinkat, SYS_mkdirat, SYS_linkat, SYS_symlinkat, SYS_fallocate, SYS_flock, SYS_fchmod,
};
enum { COUNT = sizeof WATCHED / sizeof *WATCHED };

static long at, all, result, calls;
static const char *counted;

/* Reports whether a call changes a disk: not if it opens a file for reading, or writes to standard output or error. */
static int changes_disk(long number, const long *arguments) {
    switch (number) {
    case SYS_openat: return (arguments[2] & (O_CREAT | O_TRUNC | O_WRONLY | O_RDWR)) != 0;
#ifdef SYS_open
    case SYS_open: return (arguments[1] & (O_CREAT | O_TRUNC | O_WRONLY | O_RDWR)) != 0;
#endif
    case SYS_write:
    case SYS_writev: return arguments[0] > 2;
    default: return 1;
    }
}

static void on_call(int signal, siginfo_t *info, void *context) {
    (void)signal;
    ucontext_t *machine = context;
    long number = info->si_syscall, arguments[5] = ARGUMENTS(machine);
    int saved = errno;
    if (changes_disk(number, arguments)) {
        long call = __atomic_add_fetch(&calls, 1, __ATOMIC_SEQ_CST);
        if (at && (call == at || (all && call > at))) {
            if (result == 0) {
                syscall(SYS_kill, getpid(), SIGKILL);
            }
            RESULT(machine) = result;
            errno = saved;
            return;
        }
    }
    long made = syscall(number, arguments[0], arguments[1], arguments[2], arguments[3], arguments[4], (long)OURS);
    RESULT(machine) = made < 0 ? -errno : made;
    errno = saved;
}

__attribute__((destructor)) static void write_count(void) {
    if (!counted) {
        return;
    }
    char text[24];
    int length = snprintf(text, sizeof text, "%ld\n", calls);
    int file = syscall(SYS_openat, AT_FDCWD, counted, O_CREAT | O_WRONLY | O_TRUNC, 0666, 0L, (long)OURS);
    syscall(SYS_write, file, text, (long)length, 0L, 0L, (long)OURS);
}

__attribute__((constructor)) static void begin(void) {
    const char *where = getenv("FAULT_AT"), *kind = getenv("FAULT_KIND");
    if (!where) {
        return;
    }
    at = atol(where);
    all = getenv("FAULT_ALL") != NULL;
    counted = getenv("FAULT_COUNT");
    /* 0 stands for KILL. */
    result = !kind || !strcmp(kind, "ENOSPC") ? -ENOSPC
        : !strcmp(kind, "EIO")                ? -EIO
        : !strcmp(kind, "EROFS")              ? -EROFS
                                              : 0;

    struct sigaction action = {.sa_sigaction = on_call, .sa_flags = SA_SIGINFO | SA_NODEFER | SA_ONSTACK | SA_RESTART};
    struct sock_filter filter[COUNT + 9];
    int length = 0;
#define LOAD(field) (struct sock_filter) BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, field))
#define IF_EQUAL(value, yes, no) (struct sock_filter) BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, value, yes, no)
#define ANSWER(what) (struct sock_filter) BPF_STMT(BPF_RET | BPF_K, what)
    filter[length++] = LOAD(arch);
    filter[length++] = IF_EQUAL(ARCH, 1, 0);
    filter[length++] = ANSWER(SECCOMP_RET_ALLOW);
    filter[length++] = LOAD(args[5]);
    filter[length++] = IF_EQUAL(OURS, 0, 1);
    filter[length++] = ANSWER(SECCOMP_RET_ALLOW);
    filter[length++] = LOAD(nr);
    for (int each = 0; each < COUNT; each++) {
        filter[length++] = IF_EQUAL(WATCHED[each], COUNT - each, 0);
    }
    filter[length++] = ANSWER(SECCOMP_RET_ALLOW);
    filter[length++] = ANSWER(SECCOMP_RET_TRAP);
    struct sock_fprog program = {.len = length, .filter = filter};
    if (sigaction(SIGSYS, &action, NULL) || prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) ||
        prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &program)) {
        perror("the fault shim cannot install its filter");
        _exit(77);
    }
}

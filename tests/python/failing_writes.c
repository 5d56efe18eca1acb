/* Runs a command and makes one change of files below FAULT_ROOT fail with "no space left": the one whose number is FAULT_AT, counted from 1, and all
   after it if FAULT_DIES is set, as on a disk that stays full. Counts into the file FAULT_COUNT. Called by test_failing_writes.py.

   The kernel holds each such system call of the command and its children until this program has decided (seccomp_unotify(2)), whether
   it comes from the C library or not. */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/filter.h>
#include <linux/openat2.h>
#include <linux/seccomp.h>
#include <poll.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

/* Where a system call has the folder and the path that it changes; -1: none. A file alone is a folder without a path. */
struct call { int number, folder, path, flags; };

static const struct call CALLS[] = {
#ifdef SYS_open
    {SYS_open, -1, 0, 1}, {SYS_creat, -1, 0, -1}, {SYS_mkdir, -1, 0, -1}, {SYS_rename, -1, 1, -1}, {SYS_link, -1, 1, -1},
    {SYS_symlink, -1, 1, -1}, {SYS_unlink, -1, 0, -1}, {SYS_rmdir, -1, 0, -1},
#endif
#ifdef SYS_renameat
    {SYS_renameat, 2, 3, -1},
#endif
    {SYS_openat, 0, 1, 2}, {SYS_openat2, 0, 1, 2}, {SYS_mkdirat, 0, 1, -1}, {SYS_renameat2, 2, 3, -1}, {SYS_linkat, 2, 3, -1},
    {SYS_symlinkat, 1, 2, -1}, {SYS_unlinkat, 0, 1, -1}, {SYS_write, 0, -1, -1}, {SYS_pwrite64, 0, -1, -1}, {SYS_writev, 0, -1, -1},
    {SYS_pwritev, 0, -1, -1}, {SYS_copy_file_range, 2, -1, -1}, {SYS_sendfile, 0, -1, -1}, {SYS_ftruncate, 0, -1, -1},
    {SYS_fallocate, 0, -1, -1}, {SYS_fsync, 0, -1, -1}, {SYS_fdatasync, 0, -1, -1},
};
#define LENGTH(list) (sizeof(list) / sizeof *(list))

static void give_up(const char *what) { perror(what); exit(125); }

/* In the child: all of CALLS wait for whoever reads the file that this returns. */
static int hold_calls(void) {
    struct sock_filter filter[2 + 2 * LENGTH(CALLS)] = {BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr))};
    size_t at = 1;
    for (size_t i = 0; i < LENGTH(CALLS); i++) {
        filter[at++] = (struct sock_filter)BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, CALLS[i].number, 0, 1);
        filter[at++] = (struct sock_filter)BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_USER_NOTIF);
    }
    filter[at++] = (struct sock_filter)BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW);
    struct sock_fprog program = {at, filter};
    if (prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)) give_up("no new privileges");
    int file = syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_NEW_LISTENER, &program);
    if (file < 0) give_up("seccomp");
    return file;
}

/* Sends an open file through a socket, or receives one if it is negative. */
static int pass(int socket, int file) {
    char byte = 0, space[CMSG_SPACE(sizeof(int))] = {0};
    struct iovec part = {&byte, 1};
    struct msghdr message = {.msg_iov = &part, .msg_iovlen = 1, .msg_control = space, .msg_controllen = sizeof space};
    if (file < 0) {
        if (recvmsg(socket, &message, 0) < 1 || !CMSG_FIRSTHDR(&message)) exit(125);
        memcpy(&file, CMSG_DATA(CMSG_FIRSTHDR(&message)), sizeof file);
        return file;
    }
    *CMSG_FIRSTHDR(&message) = (struct cmsghdr){.cmsg_len = CMSG_LEN(sizeof file), .cmsg_level = SOL_SOCKET, .cmsg_type = SCM_RIGHTS};
    memcpy(CMSG_DATA(CMSG_FIRSTHDR(&message)), &file, sizeof file);
    return sendmsg(socket, &message, 0);
}

static void read_memory(int pid, unsigned long long at, char *to, size_t length) {
    char name[64];
    snprintf(name, sizeof name, "/proc/%d/mem", pid);
    memset(to, 0, length);
    int memory = open(name, O_RDONLY);
    /* A path may end just before a page that is not there. */
    for (size_t done = 0; done < length && pread(memory, to + done, 1, at + done) == 1 && (to[done] || length <= 8); done++);
    close(memory);
}

static int is_below_root(int pid, const struct call *call, const unsigned long long *arguments) {
    const char *root = getenv("FAULT_ROOT");
    char link[64], path[4096] = "", whole[8300] = "";
    int folder = call->folder < 0 ? AT_FDCWD : (int)arguments[call->folder];
    if (call->path < 0 && folder <= 2) return 0;
    if (call->path >= 0) read_memory(pid, arguments[call->path], path, sizeof path - 1);
    if (path[0] != '/') {
        snprintf(link, sizeof link, folder == AT_FDCWD ? "/proc/%d/cwd" : "/proc/%d/fd/%d", pid, folder);
        if (readlink(link, whole, 4096) < 0) return 0;
        strcat(whole, "/");
    }
    strcat(whole, path);
    return root && !strncmp(whole, root, strlen(root));
}

static int is_change(int pid, const struct call *call, const unsigned long long *arguments) {
    if (call->flags >= 0) {
        unsigned long long flags = arguments[call->flags];
        if (call->number == SYS_openat2) read_memory(pid, flags, (char *)&flags, sizeof flags);
        if (!(flags & (O_CREAT | O_TRUNC))) return 0;
    }
    return is_below_root(pid, call, arguments);
}

/* Counts a change and decides about it. */
static int fails(void) {
    static int number;
    const char *at = getenv("FAULT_AT"), *note = getenv("FAULT_COUNT");
    FILE *file = note ? fopen(note, "w") : NULL;
    number++;
    if (file) { fprintf(file, "%d", number); fclose(file); }
    return at && (number == atoi(at) || (getenv("FAULT_DIES") && number > atoi(at)));
}

static void answer(int calls) {
    struct seccomp_notif call = {0};
    if (ioctl(calls, SECCOMP_IOCTL_NOTIF_RECV, &call)) return;
    const struct call *known = CALLS;
    while (known->number != call.data.nr) known++;
    struct seccomp_notif_resp answer = {.id = call.id, .flags = SECCOMP_USER_NOTIF_FLAG_CONTINUE};
    if (is_change(call.pid, known, call.data.args) && fails())
        answer = (struct seccomp_notif_resp){.id = call.id, .error = -ENOSPC};
    ioctl(calls, SECCOMP_IOCTL_NOTIF_SEND, &answer);
}

int main(int count, char **arguments) {
    int sockets[2];
    if (count < 2 || socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, sockets)) give_up("no command");
    int child = fork();
    if (!child) {
        pass(sockets[1], hold_calls());
        execvp(arguments[1], arguments + 1);
        _exit(127);
    }
    close(sockets[1]);
    struct pollfd calls = {.fd = pass(sockets[0], -1), .events = POLLIN};
    int status;
    /* Milliseconds; the end of the command wakes nobody on older kernels. */
    while (poll(&calls, 1, 5), (calls.revents & POLLIN) || !waitpid(child, &status, WNOHANG))
        if (calls.revents & POLLIN) answer(calls.fd);
    return WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
}

/* Stands between a program and the system's calls on files (LD_PRELOAD), and lets one of them fail.

   Calls on files in one folder are counted by their kind, as far as commands make them. The n-th of a kind fails, is cut short, or kills or interrupts the
   process.
   Calls that change a file outside that folder are recorded: there must be none. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <dirent.h>
#include <unistd.h>

/* In the order of `KINDS` in io_faults.py */
enum kind { OPEN, CREATE, LIST, STATUS, READ, WRITE, SYNC, RENAME, REMOVE, MAKE, LOCK, ALLOCATE, KINDS };
enum action { COUNT, FAIL_ONCE, FAIL_ON, CUT_SHORT, KILL, INTERRUPT };
enum verdict { GO_ON, FAILED, HALF };

static char folder[PATH_MAX];
static enum kind struck;
static enum action action;
static long nth;
static int error_number;
static long counts[KINDS];
static long injected;
static FILE *diary;
static char stray[PATH_MAX + 64];
static pthread_mutex_t guard = PTHREAD_MUTEX_INITIALIZER;

void faults_arm(const char *in_folder, int kind, int what, long at, int error, const char *diary_path)
{
    struck = kind, action = what, nth = at, error_number = error, injected = 0, stray[0] = 0;
    memset(counts, 0, sizeof counts);
    diary = diary_path ? fopen(diary_path, "we") : NULL;
    snprintf(folder, sizeof folder, "%s", in_folder);
}

void faults_disarm(void)
{
    folder[0] = 0;
    if (diary)
        fclose(diary);
    diary = NULL;
}

long faults_injected(void) { return injected; }
const char *faults_stray(void) { return stray; }

static void *next(const char *name)
{
    void *found = dlsym(RTLD_NEXT, name);
    if (!found)
        abort();
    return found;
}

#define NEXT(name) \
    static __typeof(name) *original; \
    if (!original) \
        original = next(#name)

static int within(const char *path, const char *place)
{
    size_t length = strlen(place);
    return strncmp(path, place, length) == 0 && (path[length] == '/' || path[length] == 0);
}

static int may_change(const char *path)
{
    return within(path, folder) || within(path, "/dev") || within(path, "/proc") || strncmp(path, "/memfd:", 7) == 0 || path[0] != '/';
}

/* Count a call on a path, and tell what is to become of it */
static enum verdict judge(enum kind kind, int changes, const char *path, const char *name)
{
    enum verdict verdict = GO_ON;
    int fate = 0;
    if (!folder[0])
        return GO_ON;
    pthread_mutex_lock(&guard);
    if (!within(path, folder)) {
        if (changes && !stray[0] && !may_change(path))
            snprintf(stray, sizeof stray, "%s %s", name, path);
    } else {
        long count = ++counts[kind];
        if (diary)
            fprintf(diary, "%d %s %s\n", kind, name, path + strlen(folder)), fflush(diary);
        if (kind == struck && action != COUNT && (count == nth || (action == FAIL_ON && count > nth))) {
            injected++;
            fate = action == KILL ? SIGKILL : action == INTERRUPT ? SIGINT : 0;
            verdict = fate == SIGINT ? GO_ON : fate || action == CUT_SHORT ? HALF : FAILED;
        }
    }
    pthread_mutex_unlock(&guard);
    if (fate == SIGINT || (fate && kind != WRITE))
        kill(getpid(), fate);
    if (verdict == FAILED)
        errno = error_number;
    return verdict;
}

static enum verdict judge_fd(enum kind kind, int changes, int fd, const char *name)
{
    char link[64], path[PATH_MAX];
    int saved = errno;
    if (!folder[0])
        return GO_ON;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    errno = saved;
    if (length < 0)
        return GO_ON;
    path[length] = 0;
    return judge(kind, changes, path, name);
}

static enum verdict judge_at(enum kind kind, int changes, int directory, const char *path, const char *name)
{
    char whole[2 * PATH_MAX] = "", link[64];
    int saved = errno;
    if (!folder[0])
        return GO_ON;
    if (path[0] != '/') {
        if (directory == AT_FDCWD) {
            if (!getcwd(whole, PATH_MAX))
                whole[0] = 0;
        } else {
            snprintf(link, sizeof link, "/proc/self/fd/%d", directory);
            ssize_t length = readlink(link, whole, PATH_MAX - 1);
            whole[length < 0 ? 0 : length] = 0;
        }
        strcat(whole, "/");
    }
    strncat(whole, path, PATH_MAX - 1);
    errno = saved;
    return judge(kind, changes, whole, name);
}

/* The result of a write of half the bytes; the process ends there if it is to be killed */
static ssize_t halved(ssize_t done)
{
    if (action == KILL)
        kill(getpid(), SIGKILL);
    return done;
}

static size_t half(size_t count) { return count > 1 ? count / 2 : count; }

/* On 64-bit systems these are the same functions */
#define ALSO(name, other) extern __typeof(other) other __attribute__((alias(#name)));

#define OPENING(name, parameters, arguments, directory) \
    int name parameters \
    { \
        NEXT(name); \
        mode_t mode = 0; \
        if (flags & (O_CREAT | __O_TMPFILE)) { \
            va_list rest; \
            va_start(rest, flags); \
            mode = va_arg(rest, mode_t); \
            va_end(rest); \
        } \
        int changes = (flags & O_ACCMODE) != O_RDONLY || flags & (O_CREAT | O_TRUNC); \
        if (judge_at(flags & O_CREAT ? CREATE : OPEN, changes, directory, path, "open") == FAILED) \
            return -1; \
        return original arguments; \
    }

OPENING(open, (const char *path, int flags, ...), (path, flags, mode), AT_FDCWD)
ALSO(open, open64)
OPENING(openat, (int directory, const char *path, int flags, ...), (directory, path, flags, mode), directory)
ALSO(openat, openat64)

FILE *fopen(const char *path, const char *how)
{
    NEXT(fopen);
    int changes = how[0] != 'r' || strchr(how, '+');
    if (judge_at(how[0] == 'r' ? OPEN : CREATE, changes, AT_FDCWD, path, "fopen") == FAILED)
        return NULL;
    return original(path, how);
}
ALSO(fopen, fopen64)

#define READING(name, parameters, fd, arguments, halved_arguments) \
    ssize_t name parameters \
    { \
        NEXT(name); \
        switch (judge_fd(READ, 0, fd, #name)) { \
        case FAILED: return -1; \
        case HALF: return original halved_arguments; \
        default: return original arguments; \
        } \
    }
READING(read, (int fd, void *to, size_t count), fd, (fd, to, count), (fd, to, half(count)))
READING(pread, (int fd, void *to, size_t count, off_t at), fd, (fd, to, count, at), (fd, to, half(count), at))
ALSO(pread, pread64)

#define WRITING(name, parameters, arguments, halved_arguments) \
    ssize_t name parameters \
    { \
        NEXT(name); \
        switch (judge_fd(WRITE, 1, fd, #name)) { \
        case FAILED: return -1; \
        case HALF: return halved(original halved_arguments); \
        default: return original arguments; \
        } \
    }
WRITING(write, (int fd, const void *from, size_t count), (fd, from, count), (fd, from, half(count)))
WRITING(pwrite, (int fd, const void *from, size_t count, off_t at), (fd, from, count, at),
        (fd, from, half(count), at))
ALSO(pwrite, pwrite64)

/* numpy writes arrays through streams of the C library, whose own calls nothing can stand before */
size_t fwrite(const void *from, size_t size, size_t count, FILE *stream)
{
    NEXT(fwrite);
    if (stream == diary)
        return original(from, size, count, stream);
    switch (judge_fd(WRITE, 1, fileno(stream), "fwrite")) {
    case FAILED: return 0;
    case HALF: {
        size_t done = original(from, size, half(count), stream);
        if (action == KILL)
            fflush(stream), kill(getpid(), SIGKILL);
        errno = ENOSPC;
        return done;
    }
    default: return original(from, size, count, stream);
    }
}

/* Calls that succeed with 0 */
#define CALL(name, parameters, verdict, arguments) \
    int name parameters \
    { \
        NEXT(name); \
        if (verdict == FAILED) \
            return -1; \
        return original arguments; \
    }
CALL(rename, (const char *from, const char *to), judge_at(RENAME, 1, AT_FDCWD, to, "rename"), (from, to))
CALL(unlink, (const char *path), judge_at(REMOVE, 1, AT_FDCWD, path, "unlink"), (path))
CALL(unlinkat, (int in, const char *path, int flags), judge_at(REMOVE, 1, in, path, "unlinkat"), (in, path, flags))
CALL(rmdir, (const char *path), judge_at(REMOVE, 1, AT_FDCWD, path, "rmdir"), (path))
CALL(mkdir, (const char *path, mode_t mode), judge_at(MAKE, 1, AT_FDCWD, path, "mkdir"), (path, mode))
CALL(flock, (int fd, int operation), operation &LOCK_UN ? GO_ON : judge_fd(LOCK, 0, fd, "flock"), (fd, operation))
CALL(ftruncate, (int fd, off_t length), judge_fd(ALLOCATE, 1, fd, "ftruncate"), (fd, length))
ALSO(ftruncate, ftruncate64)
CALL(stat, (const char *restrict path, struct stat *restrict to), judge_at(STATUS, 0, AT_FDCWD, path,
    "stat"), (path, to))
ALSO(stat, stat64)
CALL(lstat, (const char *restrict path, struct stat *restrict to), judge_at(STATUS, 0, AT_FDCWD, path,
    "lstat"), (path, to))
ALSO(lstat, lstat64)
CALL(fstatat, (int in, const char *restrict path, struct stat *restrict to, int flags), judge_at(STATUS, 0,
    in, path, "fstatat"), (in, path, to, flags))
ALSO(fstatat, fstatat64)

/* No power fails here: a flush is counted, but not done, which takes most of the time off a trial */
#define FLUSHING(name) \
    int name(int fd) \
    { \
        NEXT(name); \
        if (!folder[0]) \
            return original(fd); \
        return judge_fd(SYNC, 0, fd, #name) == FAILED ? -1 : 0; \
    }
FLUSHING(fsync)
FLUSHING(fdatasync)

int fcntl(int fd, int command, ...)
{
    NEXT(fcntl);
    va_list rest;
    va_start(rest, command);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    int locks = command == F_SETLK || command == F_SETLKW;
    if (locks && ((struct flock *)argument)->l_type != F_UNLCK && judge_fd(LOCK, 0, fd, "fcntl") == FAILED)
        return -1;
    return original(fd, command, argument);
}
ALSO(fcntl, fcntl64)

DIR *opendir(const char *path)
{
    NEXT(opendir);
    return judge_at(LIST, 0, AT_FDCWD, path, "opendir") == FAILED ? NULL : original(path);
}
